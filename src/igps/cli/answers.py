"""`igps groups`, `igps outliers` and `igps explain`."""

import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from igps._parameters import check_at_least, check_share
from igps.analysis.explanation import Explanation, contents_of, explain_groups, on_surface
from igps.analysis.explanation import explain as explain_pair
from igps.analysis.groups import group_test, squared_distances, with_discovery_rates
from igps.analysis.outliers import LIMIT, measures_of
from igps.analysis.outliers import outliers as find_outliers
from igps.cli.reading import Folder, check_files, described, files_or_folder, is_called_by_file, print_failures
from igps.data.dataset import SignatureDataset
from igps.data.sources import Bodies
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.fingerprint import cache_tag
from igps.descriptors.individual import Size, keeps_size
from igps.mesh.mesh import Mesh, millimetres
from igps.mesh.surface import face_areas
from igps.nn.description import describe
from igps.report.answers import explanation_figure, groups_figure, outliers_figure, write_answer
from igps.report.tables import groups_table
from igps.signature.signature import SAMPLE_KINDS


def groups(
    root: Path,
    descriptor: str = "pretrained",
    group: str | None = None,
    strata: str | None = None,
    covariate: list[str] | None = None,
    size: bool = False,
    out: Path | None = None,
    n_permutations: int = 10_000,
    seed: int = 0,
    **reading: Any,
) -> list[dict[str, Any]]:
    """Test whether groups of bodies differ in shape: each named body of the files, such as an organ, by itself.

    Two tests by permutation, PERMANOVA and a kernel two-sample test; how large the difference is, with its interval;
    the area under the curve of a classifier by cross-validation; and false discovery rates over the bodies.

    Args:
        root: folder with one subfolder per group, or with files and a labels.csv (columns file,label and more).
        group: a column of labels.csv that tells the groups; the class if not given.
        strata: a column within whose values bodies are permuted, such as scanner.
        covariate: columns that are regressed out first: numbers, such as age, or words, such as sex.
        size: also test the size, the logarithm of the volume, in lines of its own
        out: folder for groups.csv, groups.json, and the effects as groups.svg and groups.png.
        n_permutations: number of random permutations.
        seed: of the permutations and all else that is random.
    """

    check_at_least(1, n_permutations=n_permutations)
    check_at_least(0, seed=seed)

    def columns(bodies: Bodies) -> tuple[Any, Any, Any]:
        labels = np.array(bodies.labels if group is None else bodies.column(group))
        of_strata = None if strata is None else np.array(bodies.column(strata))
        return labels, of_strata, np.hstack([_numbers(bodies, name) for name in covariate]) if covariate else None

    folder = Folder(root, labelled=group is None, check=columns)
    how: Size = "ignore" if "scale" in descriptor_of(descriptor).invariant_to else "auto"  # as its name says
    found = described(folder, descriptor, size=how, **reading)
    bodies = found.dataset.bodies
    labels, of_strata, of_covariates = columns(bodies)
    vectors = {"": found.coordinates(of_one_kind=True)}
    if size:
        if told := keeps_size("keep", found.dataset.units())[1]:
            print(told)
        vectors[", size"] = np.log([[one.volume * millimetres(one.unit) ** 3] for one in found.dataset.signatures()])
    members: dict[str, list[int]] = {}
    for i, part in enumerate(bodies.parts):
        members.setdefault(part or "all", []).append(i)
    n_pairs = len(set(zip(bodies.parts, labels, strict=True)))
    by_file = n_pairs == len(bodies) and all(map(is_called_by_file, bodies.names, bodies.parts))
    if by_file or n_pairs == len(members) in (len(set(labels)), len(bodies)):
        # Names are those of the groups, or of the files of single masks, which may come again in each group
        members = {"all": list(range(len(bodies)))}
    jobs = [(body + what, places, rows[places]) for body, places in members.items() for what, rows in vectors.items()]
    tests = with_discovery_rates([
        group_test(
            rows, labels[places].tolist(), body=body, n_permutations=n_permutations, seed=seed,
            strata=None if of_strata is None else of_strata[places].tolist(),
            covariates=None if of_covariates is None else of_covariates[places],
        )
        for body, places, rows in tqdm(jobs, desc="tests")
    ])  # fmt: skip
    print(groups_table(tests))
    print_failures(found.failures, len(bodies))
    if out is not None:
        rows = [asdict(one) for one in tests]
        for row in rows:
            row["sizes"] = " ".join(f"{name}:{count}" for name, count in row["sizes"].items())
        write_answer(out, "groups", rows, groups_figure(tests))
        print(f"written to {out}")
    return [asdict(one) for one in tests]


def _numbers(bodies: Bodies, name: str) -> Any:
    """(N, k) the numbers of a column; of one of words alone, which of them each body has."""
    words = bodies.column(name)
    if any(re.match(r"[-+.\d]|(nan|inf|infinity)$", word, re.IGNORECASE) for word in words):
        return np.array(bodies.numbers(name))[:, None]
    return np.array([[word == one for one in sorted(set(words))] for word in words], dtype=float)


def outliers(
    root: Path, descriptor: str = "pretrained", top: int = 20, out: Path | None = None, **reading: Any
) -> list[dict[str, Any]]:
    """List the bodies that are most unlike their class, to look at before the collection is trusted.

    Each is compared with the others of its class: shape, volume, how coarse it is; of meshes handles, flat sides and
    repairs; of labels what lies apart, cavities, holes, gaps, cut ends, and overlap with other labels. A score is a
    number of robust standard deviations; a body above 3.5 is an outlier. A body that is nearer to another class than
    to its own is reported.

    Args:
        root: folder with one subfolder per class, or with files and a labels.csv (columns file,label).
        top: how many to list.
        out: folder for outliers.csv and outliers.json with all, and pictures of the first as outliers.svg and .png.
    """
    check_at_least(0, top=top)
    bodies = described(Folder(root, labelled=True, needs_meshes=True), descriptor, **reading)
    dataset = bodies.dataset
    distances = squared_distances(bodies.coordinates()) ** 0.5
    measures = measures_of(dataset, n_workers=reading.get("n_workers"))
    files = dataset.bodies.paths
    subjects = files if len(set(files)) < len(files) else [file.parent for file in files]  # a mask for each organ
    found = find_outliers(distances, dataset.bodies.labels or (), measures, dataset.all_notes(), subjects)
    rows: list[dict[str, Any]] = [
        {"name": dataset.bodies.names[one.body], "class": one.label, "score": round(one.score, 3), "reason": one.reason,
         **{f"score_{name}": round(value, 3) for name, value in one.scores.items()}}
        for one in found
    ]  # fmt: skip
    width = max((len(row["name"]) for row in rows[:top]), default=4)
    print(f"{'score':>7}  {'body':<{width}}  class: why")
    for row in rows[:top]:
        print(f"{row['score']:>7.1f}  {row['name']:<{width}}  {row['class']}: {row['reason']}")
    print(f"{sum(one.is_outlier for one in found)} of {len(rows)} bodies are outliers, with a score above {LIMIT}")
    print_failures(bodies.failures, len(dataset))
    if out is not None:
        pictured = [(one, dataset.bodies.names[one.body], dataset.mesh(one.body)) for one in found[: min(top, 12)]]
        write_answer(out, "outliers", rows, outliers_figure(pictured) if pictured else None)
        print(f"written to {out}")
    return rows


def explain(
    meshes: list[Path], descriptor: str = "pretrained", level: float = 0.05, out: Path | None = None, **reading: Any
) -> dict[str, Any]:
    """Tell where two bodies differ, or two groups of bodies: their distance, shared out and painted on both.

    Args:
        meshes: two files, or a folder with two classes.
        descriptor: of histograms, such as interior, rich or pretrained.
        level: of two groups, only cells of the histograms count whose means differ significantly, at this family-wise
            error rate.
        out: folder for explain.csv, the shares of the histograms; explain_samples.csv, those of the samples; and both
            bodies painted from two sides as explain.svg and explain.png.
    """
    check_share(level=level)
    source = files_or_folder(meshes)
    if not isinstance(source, Folder):
        if len(source) != 2:
            raise ValueError(f"meshes: expected two files, or a folder of two classes, got {len(source)} files.")
        check_files(source)
    contents_of(descriptor_of(descriptor))  # refuses others before anything is computed
    if isinstance(source, Folder):
        folder = Folder(source.root, labelled=True, needs_meshes=True, check=_check_two_classes)
        bodies = described(folder, descriptor, **reading)
        _check_two_classes(bodies.dataset.bodies)  # those that are left
        dataset, module, labels = bodies.dataset, bodies.descriptor, np.array(bodies.dataset.bodies.labels)
        inner, n_workers = contents_of(module), reading.get("n_workers")
        descriptions = describe(dataset, inner, cache_tag=cache_tag(inner), n_workers=n_workers, progress=True)
        classes = sorted(set(labels))
        members = [np.flatnonzero(labels == name) for name in classes]
        squares = squared_distances(inner.coordinates(descriptions).double().numpy())
        chosen = [int(own[squares[np.ix_(own, own)].sum(axis=1).argmin()]) for own in members]  # the medoids
        batches = [dataset.batch([i]) for i in chosen]
        found, kept = explain_groups(module, descriptions[members[0]], descriptions[members[1]], batches, level=level)
        print(f"{int(kept.sum())} of {len(kept)} cells differ by more than chance; painted: the middle of each group")
    else:
        bodies, chosen = described(source, descriptor, **{**reading, "strict": True}), [0, 1]
        dataset, module = bodies.dataset, bodies.descriptor
        if len(dataset) != 2:
            told = ", ".join(dataset.bodies.names[:4])
            raise ValueError(f"meshes: expected two bodies, got {len(dataset)}: {told}. Name each as FILE#PART.")
        found = explain_pair(module, *(dataset.batch([i]) for i in chosen))
    names = [dataset.bodies.names[i] for i in chosen]
    print(f"{' and '.join(names)}: {found.distance:.4g} by {module.name}: {found.summary()}")
    painted = [_painted(dataset, i, found, place) for place, i in enumerate(chosen)]
    for name, mesh, values in painted:
        print(f"{name}: {_extent(values, face_areas(mesh.vertices, mesh.faces))}")
    parts = [{"histogram": name, "share": share} for name, share in found.parts.items()]
    if out is not None:
        write_answer(out, "explain_samples", _sample_rows(dataset, chosen, found))
        write_answer(out, "explain", parts, explanation_figure(painted))
        print(f"written to {out}")
    return {"bodies": names, "distance": found.distance, "shares": parts}


def _check_two_classes(bodies: Bodies) -> None:
    if (n := len(set(bodies.labels or ()))) != 2:
        raise ValueError(f"meshes: expected a folder of two classes, got {n}.")


def _painted(dataset: SignatureDataset, i: int, found: Explanation, place: int) -> tuple[str, Mesh, Any]:
    """A body's name and mesh, and what each of its faces has of the difference."""
    mesh, signature = dataset.mesh(i), dataset[i].signature
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    samples = {kind: getattr(signature, kind).points for kind in SAMPLE_KINDS}
    return dataset.bodies.names[i], mesh, on_surface((found.places or found.samples)[place], samples, centres)


def _extent(values: Any, areas: Any) -> str:
    """The smallest share of the surface that holds half of all that is positive, of (F,) faces, in words."""
    order = np.argsort(-values)
    held = np.cumsum(np.maximum(values, 0)[order] * areas[order])
    if not held[-1]:
        return "none of the difference lies on its surface"
    half = (np.cumsum(areas[order]) / areas.sum())[np.searchsorted(held, held[-1] / 2)]
    return f"half of its share lies on {100 * half:.2g}% of its surface"


def _sample_rows(dataset: SignatureDataset, chosen: list[int], found: Explanation) -> list[dict[str, Any]]:
    return [
        {"name": dataset.bodies.names[i], "samples": kind, **dict(zip("xyz", point, strict=True)),
         "share": float(share), "share_by_place": float(placed)}
        for i, shares, places in zip(chosen, found.samples, found.places or found.samples, strict=True)
        for kind in SAMPLE_KINDS
        for point, share, placed in zip(
            getattr(dataset[i].signature, kind).points.tolist(), shares[kind], places[kind], strict=True
        )
    ]  # fmt: skip
