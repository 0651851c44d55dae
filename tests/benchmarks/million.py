"""A gallery of a million random vectors: `python tests/benchmarks/million.py [--n N] [--folder FOLDER]`.

The vectors form families of 250, whose members differ by noise of a tenth of their length and are in random order, as
in a gallery. With `--noise 0.7`, the nearest vectors of a query belong to several families and are spread over many
clusters of the index. The script prints the cost of building the gallery, the time of queries with and without
conditions, and the recall of the ten nearest vectors.
"""

from __future__ import annotations

import argparse
import resource
import time
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from igps.gallery import _table
from igps.gallery._search import nearest_rows
from igps.gallery._table import BodyTable
from igps.gallery.gallery import CANDIDATES
from igps.retrieval import cosine

WIDTH, FAMILY, BATCH, TOP = 256, 250, 10_000, 10
AMPLITUDES = (1 + np.arange(WIDTH, dtype=np.float32)) ** -0.5
CONDITIONS = {
    "all": "",
    "1 % at random": "volume < 0.01",
    "1 % by class": "class IN ('3', '4', '5', '6', '7')",
}


def members(centres: np.ndarray, noise: float, generator: np.random.Generator) -> np.ndarray:
    vectors = (
        centres + noise * generator.standard_normal(centres.shape, dtype=np.float32)
    ) * AMPLITUDES
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@cache
def families(n_rows: int) -> np.ndarray:
    """(n_rows / 250, 256) centres of the families."""
    return np.random.default_rng(0).standard_normal((n_rows // FAMILY, WIDTH), dtype=np.float32)


def batch(start: int, n_rows: int, noise: float) -> tuple[torch.Tensor, list[dict[str, Any]]]:
    """Vectors and rows of the table from a position on. Each family has the same share of every batch."""
    generator = np.random.default_rng([1, start])
    centres = families(n_rows)
    family = np.arange(start, start + BATCH) % len(centres)
    vectors = members(centres[family], noise, generator)
    area, volume = generator.random((2, BATCH))
    rows = [
        {
            "id": f"/meshes/{n:07}.off",
            "name": f"{n:07}",
            "class": str(family[i] % 500),
            "file": f"/meshes/{n:07}.off",
            "checksum": f"{n:064x}",
            "bytes": n,
            "modified": n,
            "area": area[i],
            "volume": volume[i],
            "thumbnail": generator.bytes(900),
        }
        for i, n in enumerate(range(start, start + BATCH))
    ]
    return torch.from_numpy(vectors), rows


def queries(n: int, n_rows: int, noise: float) -> np.ndarray:
    """(n, 256) further members of random families."""
    generator = np.random.default_rng(2)
    centres = families(n_rows)
    return members(centres[generator.integers(0, len(centres), n)], noise, generator)


def exact_nearest(vectors: np.ndarray, n_rows: int, noise: float) -> dict[str, np.ndarray]:
    """Indices (Q, 10) of the nearest rows under each condition, by comparison with all rows."""
    distances = {name: np.full((len(vectors), TOP), np.inf) for name in CONDITIONS}
    indices = {name: np.zeros((len(vectors), TOP), dtype=np.int64) for name in CONDITIONS}
    for start in range(0, n_rows, BATCH):
        batch_vectors, rows = batch(start, n_rows, noise)
        batch_distances = 1 - vectors @ batch_vectors.numpy().T
        label = np.array([int(row["class"]) for row in rows])
        masks = {
            "all": np.ones(BATCH, bool),
            "1 % at random": np.array([row["volume"] < 0.01 for row in rows]),
            "1 % by class": (label >= 3) & (label <= 7),
        }
        for name, mask in masks.items():
            batch_indices = np.broadcast_to(
                start + np.flatnonzero(mask), (len(vectors), int(mask.sum()))
            )
            candidates = np.hstack([distances[name], batch_distances[:, mask]])
            candidate_indices = np.hstack([indices[name], batch_indices])
            best = np.argsort(candidates, axis=1)[:, :TOP]
            distances[name] = np.take_along_axis(candidates, best, axis=1)
            indices[name] = np.take_along_axis(candidate_indices, best, axis=1)
    return indices


def main() -> None:
    """Build the gallery if it does not exist, and search it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=1_000_000)
    parser.add_argument("--noise", type=float, default=0.1)
    parser.add_argument("--n_queries", type=int, default=200)
    parser.add_argument("--folder", type=Path, default=Path("build/million.igps"))
    arguments = parser.parse_args()
    if not arguments.folder.exists():
        start = time.monotonic()
        batches = (
            batch(start, arguments.n, arguments.noise) for start in range(0, arguments.n, BATCH)
        )
        _table.write(arguments.folder, {"descriptor": "made"}, "cosine", batches, {})
        size = sum(path.stat().st_size for path in arguments.folder.rglob("*") if path.is_file())
        print(
            f"built in {time.monotonic() - start:.0f} s, {size / 2**30:.2f} GiB, {memory()}",
            flush=True,
        )
    table = BodyTable(arguments.folder)
    vectors = queries(arguments.n_queries, arguments.n, arguments.noise)
    answers: dict[str, list[list[int]]] = {}
    seconds: dict[str, list[float]] = {}
    for name, where in CONDITIONS.items():
        for query in torch.from_numpy(vectors):
            start = time.perf_counter()
            rows, _, _ = nearest_rows(
                table, query[None], cosine, top=TOP, candidates=CANDIDATES, where=where or None
            )
            seconds.setdefault(name, []).append(time.perf_counter() - start)
            answers.setdefault(name, []).append([int(row["name"]) for row in rows])
    search_memory = memory()
    for name, expected in exact_nearest(vectors, arguments.n, arguments.noise).items():
        pairs = zip(answers[name], expected.tolist(), strict=True)
        recall = np.mean([len(set(answer) & set(exact)) / TOP for answer, exact in pairs])
        median, slow = (1e3 * np.quantile(seconds[name], share) for share in (0.5, 0.99))
        print(
            f"{name}: {median:.1f} ms (median), {slow:.1f} ms (99 %), recall {recall:.4f} at {TOP}; {search_memory}"
        )


def memory() -> str:
    """The peak memory of this process."""
    return f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB"


if __name__ == "__main__":
    main()
