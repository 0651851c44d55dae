"""`igps retrieve`, `igps extract` and `igps query`."""

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor
from tqdm import tqdm

from igps._parameters import check_at_least
from igps.analysis.comparison import pair_distances
from igps.cli.feature_table import SUFFIXES, feature_table, wide_table, write_table
from igps.cli.gallery import as_described
from igps.cli.reading import (
    Described,
    Folder,
    check_files,
    described,
    files_or_folder,
    print_failures,
    tell_units,
    write_notes,
)
from igps.cli.report import check_report
from igps.cli.report import report as write_report
from igps.data.sources import Bodies
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.individual import IndividualDescriptor
from igps.gallery.about import is_gallery
from igps.gallery.gallery import Gallery
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor
from igps.report.results import write_sources
from igps.report.tables import scores_table, write_rows
from igps.retrieval import N_RERANKED, RetrievalScores, rank, rerank_found, retrieval_scores, search
from igps.retrieval import rerank as reranked_distances


def retrieve(
    root: Path,
    descriptor: str = "pretrained",
    out: Path | None = None,
    report: bool = False,
    rerank: bool = False,
    **reading: Any,
) -> dict[str, Any]:
    """Query a labelled collection with each of its meshes and print the retrieval scores.

    Every mesh is compared with all others (leave-one-out) by the descriptor's own distance.

    Args:
        root: folder with one subfolder per class, or with meshes and a labels.csv (columns file,label).
        out: folder for scores.json, ranking.csv, distances.npz, meshes.json that tells where the meshes lie, and
            failures.csv if a mesh could not be used; and descriptor.safetensors if the descriptor's centres were fitted
            to the collection, for queries.
        report: make a page of the results in that folder, report.html, see `igps report`
        rerank: also score the distances re-ranked by diffusion and k-reciprocal neighbours, without labels, in a table
            of their own; distances.npz has them as "reranked".
    """
    check_report(report, out)
    found = described(Folder(root, labelled=True, check=_check_scored), descriptor, **reading)
    labels = found.dataset.bodies.labels or ()
    distances = {"distances": pair_distances(found.descriptor, found.descriptions, progress=True)}
    scores = retrieval_scores(distances["distances"], labels)
    summary = _summary(found, scores)
    told = scores_table(scores)
    if rerank:
        distances["reranked"] = reranked_distances(distances["distances"], progress=True)
        scores = retrieval_scores(distances["reranked"], labels)
        summary["reranked"] = scores.mean()
        told += f"\n\nre-ranked by the whole collection, without its labels\n{scores_table(scores)}"
    if out is not None:  # before printing, which a pipe into `head` may end
        _write_retrieval(out, found, summary, distances)
    print(told)
    print_failures(found.failures, len(found.dataset))
    if out is not None:
        print(f"written to {out}")
        if report:
            write_report(out, n_workers=reading.get("n_workers"))
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

    A table (.csv or .parquet) has a row for each body: file, part, name, class, further columns of labels.csv, unit of
    length, volume, area, and the description as v0, v1 and so on. A NumPy archive (.npz) has `features` (N, ...) as the
    descriptor gives them, `names` (N,), and `labels` (N,) where the meshes come from a folder with classes.

    Args:
        meshes: mesh files, or one folder.
        out: the file, ending in .csv, .parquet or .npz; what was done to meshes that were mended is written beside it,
            in a file of the same name ending in .notes.csv.
        short: write unit vectors of at most 256 numbers in place of longer ones, for engines that compare by the cosine
            (pretrained).
        wide: write a row for each file, or folder of a mask for each organ, with columns PART.volume, PART.v0 and so on
            for each of its bodies.
    """
    suffix = out.suffix.lower()
    if wide and suffix == ".npz":
        raise ValueError(f"out: expected a file of a wide table ending in {' or '.join(SUFFIXES)}, got {out}.")
    chosen = descriptor_of(descriptor)
    plain = chosen.descriptor if isinstance(chosen, IndividualDescriptor) else chosen
    if short and not isinstance(plain, EmbeddedDescriptor):
        raise ValueError(f"short: expected a descriptor of vectors, such as pretrained, got {descriptor!r}.")
    found = described(files_or_folder(meshes), descriptor, **reading)
    features = (found.descriptor.short(found.descriptions) if short else found.descriptions).numpy()
    out.parent.mkdir(parents=True, exist_ok=True)
    if suffix == ".npz":
        bodies = found.dataset.bodies
        labels: dict[str, Any] = {} if bodies.labels is None else {"labels": np.array(bodies.labels)}
        np.savez_compressed(out, features=features, names=np.array(bodies.names), **labels)
    else:
        known, measured = feature_table(found.dataset, features)
        table = wide_table(known, measured) if wide else {**known, **measured}
        write_table(out, table)
    write_notes(out.with_suffix(".notes.csv"), found.dataset)
    rows = f", rows: {len(next(iter(table.values())))}" if wide else ""
    print(f"{len(features)} descriptions of shape {features.shape[1:]} written to {out}{rows}")
    print_failures(found.failures, len(features))


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
        rerank: order the nearest 200 by the neighbours they have in common (diffusion and k-reciprocal re-ranking,
            without labels); the distances listed are those of this order.
    """
    check_at_least(1, top=top)
    check_files([mesh])
    if is_gallery(gallery):
        opened = Gallery(gallery, descriptor)
        wanted = _one(mesh, opened.descriptor, **as_described(opened, reading))
        matches = opened.nearest(wanted, top=top, rerank=rerank, where=where, exact=exact)[0]
        n_missing = sum(not match.path.exists() for match in matches)
        found = [(match.name, match.label, match.distance) for match in matches]
    elif where is not None:
        raise ValueError(f"where: expected a gallery, {gallery} is a folder of meshes. See igps gallery build.")
    else:
        known, n_missing = described(Folder(gallery), descriptor or "pretrained", **reading), 0
        as_known = {"paper": False, "signature": known.dataset.config, **asdict(known.dataset.reading)}
        wanted = _one(mesh, known.descriptor, **{**reading, **as_known})  # a file of signatures tells how
        bodies, distance = known.dataset.bodies, known.descriptor.distances
        n_found = min(top, len(bodies))
        n_near = min(max(top, N_RERANKED), len(bodies)) if rerank else n_found
        near = search(wanted, known.descriptions, top=n_near, distance=distance)
        if rerank:
            near = rerank_found(wanted, near, lambda indices: known.descriptions[indices], distance, top=n_found)
        places = zip(near.indices[0].tolist(), near.distances[0].tolist(), strict=True)
        found = [(bodies.names[i], None if bodies.labels is None else bodies.labels[i], away) for i, away in places]
    rows: list[dict[str, Any]] = [
        {"rank": place, "distance": away, "name": name, "class": label}
        for place, (name, label, away) in enumerate(found, 1)
    ]
    width = max((len(row["name"]) for row in rows), default=4)
    print(f"{'rank':>4}  {'distance':>9}  {'mesh':<{width}}  class")
    for row in rows:
        print(f"{row['rank']:>4}  {row['distance']:>9.3g}  {row['name']:<{width}}  {row['class'] or '-'}")
    if n_missing:
        print(f"{n_missing} of these {len(rows)} files are no longer where they were when they were described.")
    return rows


def _one(mesh: Path, descriptor: Descriptor, **reading: Any) -> Tensor:
    """The description of the one body of a file, or of the one that is named."""
    found = described([mesh], descriptor, **{**reading, "n_workers": 1})
    tell_units(descriptor, found.dataset)
    if len(found.dataset) > 1:
        names = ", ".join(found.dataset.bodies.names[:5])
        raise ValueError(
            f"mesh: expected one body, {mesh} holds {len(found.dataset)}. Name one of them, such as {names}."
        )
    return found.descriptions


def _check_scored(bodies: Bodies) -> None:
    if len(set(bodies.labels or ())) == len(bodies):
        raise ValueError(f"root: expected a class of two bodies or more, got {len(bodies)} of one. Put like together.")


def _summary(found: Described, scores: RetrievalScores) -> dict[str, Any]:
    n_used, n_refused = len(found.dataset), len(found.failures)
    return {
        **scores.mean(),
        "n_queries": scores.n_queries,
        "n_given": n_used + n_refused,
        "n_used": n_used,
        "n_refused": n_refused,
        "per_class": {str(label): values for label, values in scores.per_class().items()},
        "config": {"descriptor": found.name or found.descriptor.name, **found.dataset.config.as_dict()},
    }


def _write_retrieval(out: Path, found: Described, summary: dict[str, Any], distances: dict[str, Tensor]) -> None:
    out.mkdir(parents=True, exist_ok=True)
    names, labels = found.dataset.bodies.names, found.dataset.bodies.labels or ()
    (out / "scores.json").write_text(json.dumps(summary, indent=2) + "\n")
    arrays: dict[str, Any] = {name: values.numpy() for name, values in distances.items()}
    np.savez_compressed(out / "distances.npz", names=np.array(names), labels=np.array(labels), **arrays)

    def ranking() -> Iterator[tuple[Any, ...]]:
        for i, order in enumerate(tqdm(rank(distances["distances"]), desc="rankings")):
            away = distances["distances"][i].tolist()  # a tensor's entries one by one would take most of the time
            for place, j in enumerate(order[order != i].tolist(), 1):
                yield names[i], place, names[j], f"{away[j]:.6g}", int(labels[i] == labels[j])

    write_rows(out / "ranking.csv", ("query", "rank", "model", "distance", "relevant"), ranking())
    write_rows(out / "failures.csv", ("name", "error"), [(one.id, one.error) for one in found.failures])
    write_notes(out / "notes.csv", found.dataset)
    write_sources(out, found.dataset)
    if found.name is None:  # its centres are the collection's
        found.descriptor.save(out / "descriptor.safetensors")
