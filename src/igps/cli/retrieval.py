"""`igps retrieve`, `igps extract` and `igps query`."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor
from tqdm import tqdm

from igps.analysis.comparison import pair_distances
from igps.cli.feature_table import SUFFIXES, feature_table, wide_table, write_table
from igps.cli.gallery import as_described
from igps.cli.reading import Folder, signatures, sized, with_side, write_notes, write_rows
from igps.cli.report import check_report
from igps.cli.report import report as write_report
from igps.data.dataset import Failure, SignatureDataset
from igps.data.sources import Bodies
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.fingerprint import cache_tag, name_of
from igps.descriptors.individual import IndividualDescriptor, Mirror, Size
from igps.gallery.about import is_gallery
from igps.gallery.gallery import Gallery
from igps.nn.description import describe, fit_centres
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor
from igps.report.sources import write_sources
from igps.report.tables import scores_table
from igps.retrieval import N_RERANKED, RetrievalScores, rank, rerank_found, retrieval_scores, search
from igps.retrieval import rerank as reranked_distances


def retrieve(
    root: Path,
    descriptor: str = "pretrained",
    out: Path | None = None,
    report: bool = False,
    rerank: bool = False,
    n_workers: int | None = None,
    strict: bool = False,
    **reading: Any,
) -> dict[str, Any]:
    """Query a labelled collection with each of its meshes and print the retrieval scores.

    Every mesh is compared with all others (leave-one-out) by the descriptor's own distance.

    Args:
        root: folder with one subfolder per class, or with meshes and a labels.csv (columns file,label).
        descriptor: a name (a wrong one lists all), or package.module:NAME of one of your own.
        out: folder for scores.json, ranking.csv, distances.npz, meshes.json that tells where the meshes lie, and
            failures.csv if a mesh could not be used; and descriptor.safetensors where the descriptor has centres that
            are the collection's, so that a query takes the same.
        report: make a page of the results in that folder, report.html, see `igps report`
        rerank: score the distances that the whole collection has set right by its neighbourhoods, too, in a table of
            their own (diffusion and k-reciprocal re-ranking, without labels); distances.npz has them as "reranked".
        n_workers: processes that compute; all cores if not given.
        strict: stop at the first mesh that cannot be used instead of skipping it
    """
    check_report(report, out)
    dataset, descriptions, failures, name = described(
        Folder(root, labelled=True), descriptor, n_workers=n_workers, strict=strict, **reading
    )
    distances = pair_distances(descriptor_of(name), descriptions, progress=True)
    scores = retrieval_scores(distances, dataset.bodies.labels or ())
    print(scores_table(scores))
    reranked = reranked_distances(distances, progress=True) if rerank else None
    scores_reranked = None if reranked is None else retrieval_scores(reranked, dataset.bodies.labels or ())
    if scores_reranked is not None:
        print(f"\nre-ranked by the whole collection, without its labels\n{scores_table(scores_reranked)}")
    if failures:
        print(f"{len(failures)} of {len(failures) + len(dataset)} meshes could not be used.")
    summary = _summary(dataset, name_of(name), scores, failures)
    if scores_reranked is not None:
        summary["reranked"] = scores_reranked.mean()
    if out is not None:
        _write_retrieval(out, dataset, summary, distances, failures, reranked)
        if isinstance(name, Descriptor):  # its centres are the collection's
            name.save(out / "descriptor.safetensors")
        print(f"written to {out}")
        if report:
            write_report(out, n_workers=n_workers)
    return summary


def extract(
    meshes: list[Path],
    out: Path,
    descriptor: str = "pretrained",
    short: bool = False,
    wide: bool = False,
    **reading: Any,
) -> None:
    """Write the descriptions of meshes to a file, for use in any classifier, statistics package or vector database.

    A table (.csv or .parquet) has a row for each body: file, part, name, label, further columns of labels.csv, unit of
    length, volume, area, and the description as v0, v1 and so on. A NumPy archive (.npz) has `features` (N, ...) as the
    descriptor gives them, `names` (N,), and `labels` (N,) where the meshes come from a folder with classes.

    Args:
        meshes: mesh files, or one folder.
        out: the file, ending in .csv, .parquet or .npz; what was done to meshes that were mended is written beside it,
            in a file of the same name ending in .notes.csv.
        descriptor: a name (a wrong one lists all), or package.module:NAME of one of your own.
        short: write unit vectors of at most 256 numbers in place of longer ones, for engines that compare by the cosine
            (pretrained).
        wide: write a row for each file, with columns PART.volume, PART.v0 and so on for each of its bodies.
    """
    suffix = out.suffix.lower()
    if suffix not in (*SUFFIXES, ".npz") or (wide and suffix == ".npz"):
        suffixes = ", ".join(SUFFIXES if wide else (*SUFFIXES, ".npz"))
        raise ValueError(f"out: expected a file{' of a wide table' * wide} ending in one of {suffixes}, got {out}.")
    source = Folder(meshes[0]) if len(meshes) == 1 and meshes[0].is_dir() else meshes
    chosen = descriptor_of(descriptor)
    plain = chosen.descriptor if isinstance(chosen, IndividualDescriptor) else chosen
    if short and not isinstance(plain, EmbeddedDescriptor):
        raise ValueError(f"short: expected a descriptor of vectors, such as pretrained, got {descriptor!r}.")
    dataset, descriptions, failures, name = described(source, descriptor, **reading)
    features = (descriptor_of(name).short(descriptions) if short else descriptions).numpy()
    out.parent.mkdir(parents=True, exist_ok=True)
    if suffix == ".npz":
        arrays: dict[str, Any] = {"features": features, "names": np.array(dataset.bodies.names)}
        if dataset.bodies.labels is not None:
            arrays["labels"] = np.array(dataset.bodies.labels)
        np.savez_compressed(out, **arrays)
    else:
        known, measured = feature_table(dataset, features)
        write_table(out, wide_table(known, measured) if wide else {**known, **measured})
    write_notes(out.with_suffix(".notes.csv"), dataset)
    print(
        f"{len(features)} descriptions of shape {features.shape[1:]} written to {out}; {len(failures)} meshes skipped"
    )


def query(
    mesh: Path,
    gallery: Path,
    top: int = 10,
    descriptor: str | None = None,
    where: str | None = None,
    exact: bool = False,
    rerank: bool = False,
    **reading: Any,
) -> list[dict[str, Any]]:
    """List the bodies of a gallery that are most similar to one mesh.

    Args:
        mesh: the file to look for, or FILE#PART, one body of several in a file.
        gallery: what igps gallery build made, or a folder of meshes, with or without classes.
        top: how many to list.
        descriptor: a name (a wrong one lists all), or package.module:NAME of one of your own; if not given, that of the
            gallery, or pretrained.
        where: only bodies that satisfy this condition on columns of the gallery, such as "class = 'femur' AND volume >
            2e5".
        exact: compare with all bodies; the nearest of a large gallery are found by short vectors otherwise
        rerank: put the nearest 200 in order by what neighbours they have in common (diffusion and k-reciprocal
            re-ranking, without labels); the distances listed are those of this order, without unit.
    """
    if top < 1:
        raise ValueError(f"top: expected at least 1, got {top}.")
    if is_gallery(gallery):
        opened = Gallery(gallery, descriptor)
        reading = as_described(opened, reading)
        wanted = _one(mesh, opened.descriptor, **{**reading, "n_workers": 1})
        matches = opened.nearest(wanted, top=top, rerank=rerank, where=where, exact=exact)[0]
        rows = [(match.name, match.label, match.distance) for match in matches]
        missing = sum(not match.path.exists() for match in matches)
        _print_found(rows)
        if missing:
            print(f"{missing} of these {len(matches)} files are no longer where they were when they were described.")
        return _as_rows(rows)
    if where is not None:
        raise ValueError(f"where: expected a gallery, {gallery} is a folder of meshes. See igps gallery build.")
    dataset, descriptions, _, name = described(Folder(gallery), descriptor or "pretrained", **reading)
    chosen, unsized = descriptor_of(name), {**reading, "size": "ignore"}  # as the name says already
    wanted = _one(mesh, name, **unsized)
    n_found = min(top, len(dataset))
    n_near = min(max(top, N_RERANKED), len(dataset)) if rerank else n_found
    found = search(wanted, descriptions, top=n_near, distance=chosen.distances)
    if rerank:
        found = rerank_found(wanted, found, lambda indices: descriptions[indices], chosen.distances, top=n_found)
    names, labels = dataset.bodies.names, dataset.bodies.labels
    places = zip(found.indices[0].tolist(), found.distances[0].tolist(), strict=True)
    rows = [(names[i], None if labels is None else labels[i], distance) for i, distance in places]
    _print_found(rows)
    return _as_rows(rows)


def _one(mesh: Path, descriptor: str | Descriptor, **reading: Any) -> Tensor:
    """The description of the one body of a file, or of the one that is named."""
    dataset, description, *_ = described([mesh], descriptor, **reading)
    if len(dataset) > 1:
        names = ", ".join(dataset.bodies.names[:5])
        raise ValueError(f"mesh: expected one body, {mesh} holds {len(dataset)}. Name one of them, such as {names}.")
    return description


def _print_found(rows: Sequence[tuple[str, str | None, float]]) -> None:
    width = max((len(name) for name, _, _ in rows), default=4)
    print(f"{'rank':>4}  {'distance':>9}  {'mesh':<{width}}  class")
    for place, (name, label, distance) in enumerate(rows, 1):
        print(f"{place:>4}  {distance:>9.3g}  {name:<{width}}  {'-' if label is None else label}")


def _as_rows(rows: Sequence[tuple[str, str | None, float]]) -> list[dict[str, Any]]:
    return [
        {"rank": place, "distance": distance, "mesh": name, "class": "-" if label is None else label}
        for place, (name, label, distance) in enumerate(rows, 1)
    ]


def described(
    source: Folder | Sequence[Path] | Bodies,
    descriptor: str | Descriptor,
    n_workers: int | None = None,
    strict: bool = False,
    size: Size = "auto",
    mirror: Mirror = "same",
    **reading: Any,
) -> tuple[SignatureDataset, Tensor, list[Failure], str | Descriptor]:
    """The meshes that could be used, their descriptions, the failures of the others, and the descriptor by name.

    Args:
        source: a folder, files, or bodies.
        descriptor: a name, to which size and mirror are added; or a descriptor as it is.
        n_workers: processes that compute; all cores if not given.
        strict: see `FLAGS`.
        size: keep lets differences in size count, ignore does not; auto keeps it where all files have a unit of length.
        mirror: distinct tells a body from its mirror image.
    """
    if isinstance(descriptor, str):
        descriptor = with_side(descriptor, mirror)
    dataset, unread = signatures(source, [descriptor_of(descriptor)], n_workers=n_workers, strict=strict, **reading)
    if isinstance(descriptor, str):
        descriptor = sized(descriptor, size, dataset)
    module = descriptor_of(descriptor)
    if fit_centres(module, dataset):  # which no name tells
        descriptor = module
    failures: list[Failure] = []
    descriptions = describe(
        dataset,
        module,
        failures=None if strict else failures,
        cache_tag=cache_tag(module),
        n_workers=n_workers,
        progress=True,
    )
    return dataset.usable(failures), descriptions, [*unread, *failures], descriptor


def _summary(
    dataset: SignatureDataset, descriptor: str, scores: RetrievalScores, failures: Sequence[Failure]
) -> dict[str, Any]:
    return {
        **scores.mean(),
        "n_queries": scores.n_queries,
        "n_given": len(dataset) + len(failures),
        "n_used": len(dataset),
        "n_refused": len(failures),
        "per_class": {str(label): values for label, values in scores.per_class().items()},
        "config": {"descriptor": descriptor, **dataset.config.as_dict()},
    }


def _write_retrieval(
    out: Path,
    dataset: SignatureDataset,
    summary: dict[str, Any],
    distances: Tensor,
    failures: Sequence[Failure],
    reranked: Tensor | None,
) -> None:
    out.mkdir(parents=True, exist_ok=True)
    names, labels = dataset.bodies.names, dataset.bodies.labels or ()
    (out / "scores.json").write_text(json.dumps(summary, indent=2) + "\n")
    arrays: dict[str, Any] = {"distances": distances.numpy(), "names": np.array(names), "labels": np.array(labels)}
    if reranked is not None:
        arrays["reranked"] = reranked.numpy()
    np.savez_compressed(out / "distances.npz", **arrays)
    with (out / "ranking.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["query", "rank", "model", "distance", "relevant"])
        for i, order in enumerate(tqdm(rank(distances), desc="rankings")):
            away = distances[i].tolist()  # a tensor's entries one by one would take most of the time
            for place, j in enumerate(order[order != i].tolist(), 1):
                writer.writerow([names[i], place, names[j], f"{away[j]:.6g}", int(labels[i] == labels[j])])
    rows = [(failure.id, failure.error) for failure in failures]
    write_rows(out / "failures.csv", ("file", "error"), rows)
    write_notes(out / "notes.csv", dataset)
    write_sources(out, dataset)
