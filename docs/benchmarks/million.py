"""A gallery of a million bodies: `python -m docs.benchmarks.million`, with `--n`, `--folder`, `--seed`.

600 generated bodies of 12 classes are described by `pretrained`. A row is a mixture of four bodies of a class with a
little of any other body and noise. The script prints the cost of building the gallery, and the time and the recall at
10 of queries with and without conditions, against the comparison with all rows by the descriptor's own distance.
Another seed gives other rows and other queries.
"""

import argparse
import resource
import time
from pathlib import Path

import numpy as np
import torch
from training.shapes.templates import TEMPLATES

import igps
from igps.gallery.gallery import CANDIDATES
from igps.gallery.table import BodyTable, write
from igps.nn.description import describe

BATCH, TOP = 10_000, 10
NOISE = 0.05  # length, beside descriptions of length 1
N_CLASSES = 12
# Of the rows among which is searched; a query has the class {own}, and {other} is another one.
CONDITIONS = {
    "all": None,
    "1 % at random": "volume < 0.01",
    "its own class of twelve": "class = '{own}'",
    "another class": "class = '{other}'",
}


def condition(name, own):
    """The condition for a query of the class `own`."""
    template = CONDITIONS[name]
    if template is None:
        return None
    return template.format(own=own, other=(own + 1) % N_CLASSES)


class Rows:
    """Descriptions that vary those of generated bodies."""

    def __init__(self, folder, seed):
        described = folder / "described.npz"
        if not described.exists():
            _describe_bodies(folder, described)
        with np.load(described) as arrays:
            self.bodies = arrays["descriptions"]
            labels = arrays["labels"]
        self.members = [np.flatnonzero(labels == label) for label in np.unique(labels)]
        self.seed = seed

    def descriptions(self, n, *keys):
        """Return n descriptions of length 1 and their classes."""
        generator = np.random.default_rng([self.seed, *keys])
        classes = generator.integers(len(self.members), size=n)
        mixed = np.empty((n, self.bodies.shape[1]), np.float32)
        for number, members in enumerate(self.members):
            chosen = np.flatnonzero(classes == number)
            weights = generator.dirichlet(np.full(4, 0.5), size=len(chosen))
            parts = members[generator.integers(len(members), size=(len(chosen), 4))]
            mixed[chosen] = np.einsum("nk,nkd->nd", weights, self.bodies[parts])
        other = self.bodies[generator.integers(len(self.bodies), size=n)]
        share = generator.uniform(0, 0.3, (n, 1)).astype(np.float32)
        noise = generator.standard_normal(mixed.shape, dtype=np.float32)
        mixed = (1 - share) * mixed + share * other
        mixed += NOISE / np.sqrt(mixed.shape[1]) * noise
        return mixed / np.linalg.norm(mixed, axis=1, keepdims=True), classes

    def batch(self, start):
        """Return the rows of the table from a position on."""
        descriptions, classes = self.descriptions(BATCH, 1, start)
        generator = np.random.default_rng([self.seed, 2, start])
        volumes = generator.random(BATCH)
        rows = []
        for i, number in enumerate(range(start, start + BATCH)):
            file = f"/meshes/{number:07}.off"
            row = {"id": file, "name": str(number), "class": str(classes[i]), "file": file}
            row |= {"checksum": f"{number:064x}", "bytes": number, "modified": number}
            row |= {"volume": volumes[i]}
            rows.append(row)
        return torch.from_numpy(descriptions), rows


def _describe_bodies(folder, out):
    shapes = igps.ArticulatedShapes(N_CLASSES, 50, n_vertices=700, templates=TEMPLATES)
    shapes.write(folder / "meshes")
    descriptor = igps.descriptor("pretrained")
    dataset = igps.SignatureDataset(
        folder / "meshes", descriptor=descriptor, cache_dir=folder / "cache"
    )
    dataset.precompute()
    descriptions = describe(dataset, descriptor).numpy()
    np.savez(out, descriptions=descriptions, labels=np.array(dataset.bodies.labels))


def exact_nearest(table, queries, classes, distance):
    """Return the names (Q, 10) of the nearest rows under each condition, by comparison with all rows."""
    distances = {name: np.full((len(queries), TOP), np.inf) for name in CONDITIONS}
    names = {name: np.zeros((len(queries), TOP), np.int64) for name in CONDITIONS}
    for batch in table.batches():
        descriptions, rows = table.decoded(batch)
        with torch.inference_mode():
            to_batch = distance(queries, descriptions).numpy()
        numbers = np.array([int(row["name"]) for row in rows])
        volumes = np.array([row["volume"] for row in rows])
        classes_of_rows = np.array([int(row["class"]) for row in rows])
        has_own_class = classes[:, None] == classes_of_rows
        has_next_class = (classes[:, None] + 1) % N_CLASSES == classes_of_rows
        masks = {
            "all": np.ones_like(has_own_class),
            "1 % at random": np.broadcast_to(volumes < 0.01, has_own_class.shape),
            "its own class of twelve": has_own_class,
            "another class": has_next_class,
        }
        for name, mask in masks.items():
            others = np.broadcast_to(numbers, mask.shape)
            candidates = np.hstack([distances[name], np.where(mask, to_batch, np.inf)])
            best = np.argsort(candidates, axis=1)[:, :TOP]
            distances[name] = np.take_along_axis(candidates, best, axis=1)
            names[name] = np.take_along_axis(np.hstack([names[name], others]), best, axis=1)
    return names


def main():
    """Build the gallery if it does not exist, and search it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=1_000_000)
    parser.add_argument("--n_queries", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--candidates", type=int, default=CANDIDATES)
    parser.add_argument("--folder", type=Path, default=Path("build/million"))
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    rows = Rows(arguments.folder, arguments.seed)
    descriptor = igps.descriptor("pretrained")
    path = arguments.folder / f"{arguments.n}-{arguments.seed}.igps"
    if not path.exists():
        start = time.monotonic()

        def batches():
            for first in range(0, arguments.n, BATCH):
                yield rows.batch(first)

        about = {"descriptor": "pretrained"}
        write(path, about, "cosine", batches(), {}, weights=descriptor.search_weights)
        size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
        seconds = time.monotonic() - start
        print(f"built in {seconds:.0f} s, {size / 2**30:.2f} GiB, {memory()}", flush=True)
    table = BodyTable(path)
    descriptions, classes = rows.descriptions(arguments.n_queries, 3)
    queries = torch.from_numpy(descriptions)
    found = {name: [] for name in CONDITIONS}
    seconds_of = {name: [] for name in CONDITIONS}
    for name in CONDITIONS:
        for query, own in zip(queries, classes.tolist(), strict=True):
            where = condition(name, own)
            start = time.perf_counter()
            with torch.inference_mode():
                nearest, _, _ = table.nearest(
                    query[None],
                    descriptor.distances,
                    top=TOP,
                    candidates=arguments.candidates,
                    where=where,
                )
            seconds_of[name].append(time.perf_counter() - start)
            found[name].append([int(row["name"]) for row in nearest])
        median, slow = (1e3 * np.quantile(seconds_of[name], share) for share in (0.5, 0.99))
        print(f"{name}: {median:.0f} ms (median), {slow:.0f} ms (99 %); {memory()}", flush=True)
    exact = exact_nearest(table, queries, classes, descriptor.distances)
    for name, expected in exact.items():
        pairs = zip(found[name], expected.tolist(), strict=True)
        shares = [len(set(one) & set(other)) / TOP for one, other in pairs]
        print(f"{name}: recall {np.mean(shares):.4f} at {TOP}", flush=True)


def memory():
    """The peak memory of this process."""
    return f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB"


if __name__ == "__main__":
    main()
