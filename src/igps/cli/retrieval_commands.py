"""The commands `igps retrieve`, `igps extract` and `igps query`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igps._parameters import check_at_least
from igps._text import counted

if TYPE_CHECKING:
    from torch import Tensor

    from igps.cli.reading import Described
    from igps.data.sources import Bodies
    from igps.nn.descriptor import Descriptor
    from igps.retrieval import RetrievalScores


def retrieve(
    root: Path,
    descriptor: str = "pretrained",
    queries: str | None = None,
    out: Path | None = None,
    report: bool = False,
    rerank: bool = False,
    **describing: Any,
) -> dict[str, Any]:
    """Query a labelled collection with each of its meshes and print the retrieval scores.

    Every mesh is compared with all others (leave-one-out) by the descriptor's own distance.

    Args:
        root: folder with one subfolder per class, or with meshes and a labels.csv (columns file,label).
        queries: bodies whose names match this pattern ask all others, and no other asks, such as "left/*".
        out: folder for scores.json, ranking.csv, distances.npz, meshes.json with the paths of the meshes, failures.csv
            if a mesh could not be used, and descriptor.safetensors, for queries, if the descriptor's centres were
            fitted to the collection.
        report: also write a page of results to the folder of --out, report.html, see igps report
        rerank: also re-rank the distances by k-reciprocal neighbours, without labels, and print their
            scores in a second table; distances.npz holds them as "reranked".
    """
    from igps._progress import number_bars
    from igps.analysis.comparison import pair_distances
    from igps.cli.reading import Folder, described
    from igps.cli.report_command import check_report_folder
    from igps.cli.report_command import report as write_report
    from igps.descriptors.measures import Measures
    from igps.retrieval import rerank as reranked_distances

    check_report_folder(report, out)
    if report and queries is not None:
        raise ValueError("report: expected no --queries with it: on the page, each body asks.")
    check = partial(_check_scored, queries=queries, needs_scores=out is None)
    folder = Folder(root, labelled=True, check=check)
    number_bars(3 + (out is not None) + report)
    result = described(folder, descriptor, also=Measures.requirements, **describing)
    is_query = check(result.dataset.bodies)
    distances = {"distances": pair_distances(result.descriptor, result.descriptions, progress=True)}
    if rerank:
        distances["reranked"] = reranked_distances(distances["distances"])
    summary = _summary(result)
    tables = "no class has two bodies: rankings without scores"
    if _has_pairs(result.dataset.bodies):
        scores, tables = _scored(result, distances, is_query)
        summary = {**scores, **summary}
    if out is not None:  # before printing, because a closed pipe, as of `head`, ends the command
        _write_retrieval(out, result, summary, distances, is_query)
    print(tables)
    if out is not None:
        print(f"written to {out}")
        if report:
            write_report(out, n_workers=describing.get("n_workers"))
    return summary


def _scored(
    result: Described, distances: dict[str, Tensor], is_query: list[bool] | None
) -> tuple[dict[str, Any], str]:
    """Return the scores for scores.json, and the tables of them to print."""
    from igps.analysis.plain_numbers import plain_scores
    from igps.report.tables import plain_table, scores_table
    from igps.retrieval import scores_of_queries

    labels = result.dataset.bodies.labels or ()
    scores = scores_of_queries(distances["distances"], labels, is_query)
    plain = plain_scores(result.dataset, is_query)
    summary = {
        **_means(scores),
        "n_queries": scores.n_queries,
        "per_class": {str(label): values for label, values in scores.per_class().items()},
        "plain_numbers": {name: row.mean() for name, row in plain.items()},
    }
    tables = [scores_table(scores)]
    if "reranked" in distances:
        reranked = scores_of_queries(distances["reranked"], labels, is_query)
        summary["reranked"] = _means(reranked)
        tables.append(
            f"\nre-ranked by the whole collection, without labels\n{scores_table(reranked)}"
        )
    tables.append(plain_table(plain, result.descriptor.name, scores))
    return summary, "\n".join(tables)


def extract(
    meshes: list[Path],
    out: Path,
    descriptor: str = "pretrained",
    short: bool = False,
    wide: bool = False,
    **describing: Any,
) -> None:
    """Write the descriptions of meshes to a file, for use in any classifier, statistics package or vector database.

    A table (.csv or .parquet) has one row per body, with the columns file, part, name, class, further columns of
    labels.csv, unit (of length), at_border (share of the surface at the border of the image), border_sides, notes,
    plain numbers such as volume_mm3 (alone with --descriptor measures), and the description, its columns named after
    its parts. A NumPy archive (.npz) has features (N, ...) as the descriptor returns them, names (N,), and labels (N,)
    if the meshes come from a folder with classes.

    Args:
        meshes: mesh files, or one folder.
        out: file ending in .csv, .parquet or .npz; notes on repaired meshes are written beside it, to a file of the
            same name ending in .notes.csv.
        short: write unit vectors of at most 256 numbers, for search engines that compare by the cosine (pretrained);
            where size or side counts, its numbers follow, see --size.
        wide: write one row per file, or per folder with one mask file per organ, and columns such as PART.volume_mm3
            for each of its bodies.
    """
    from igps._progress import number_bars
    from igps.cli.feature_table import SUFFIXES
    from igps.cli.reading import described, files_or_folder, write_mending_notes
    from igps.descriptors import descriptor as descriptor_of
    from igps.descriptors.measures import Measures
    from igps.descriptors.size_and_side import form_of
    from igps.nn.descriptor import EmbeddedDescriptor

    is_archive = out.suffix.lower() == ".npz"
    if is_archive and wide:
        raise ValueError(
            f"out: expected a file of a table ending in {' or '.join(SUFFIXES)}, got {out}."
        )
    form_descriptor = form_of(descriptor_of(descriptor))
    if short and not isinstance(form_descriptor, EmbeddedDescriptor):
        raise ValueError(
            f"short: expected a descriptor of vectors, such as pretrained, got {descriptor!r}."
        )
    also = None if is_archive else Measures.requirements
    number_bars(2)
    result = described(files_or_folder(meshes), descriptor, also=also, **describing)
    out.parent.mkdir(parents=True, exist_ok=True)
    if is_archive:
        _write_archive(out, result, short)
    else:
        _write_features(out, result, short, wide)
    write_mending_notes(out.with_suffix(".notes.csv"), result.dataset)


def _write_archive(out: Path, result: Described, short: bool) -> None:
    import numpy as np

    features = result.vectors(short)
    bodies = result.dataset.bodies
    labels: dict[str, Any] = {}
    if bodies.labels is not None:
        labels["labels"] = np.array(bodies.labels)
    np.savez_compressed(out, features=features, names=np.array(bodies.names), **labels)
    n_described = counted(len(features), "description")
    print(f"{n_described} of shape {features.shape[1:]} written to {out}")


def _write_features(out: Path, result: Described, short: bool, wide: bool) -> None:
    from igps.cli.feature_table import Table, feature_table, wide_table, write_table
    from igps.descriptors.measures import Measures

    vectors = result.vectors(short).reshape(len(result.dataset), -1)
    columns = result.descriptor.column_names(result.descriptions[0].numel())
    beside: list[str] = []
    if short:
        beside = [name for name in columns if name.startswith(("side.", "size."))]
        columns = [f"short.{i}" for i in range(vectors.shape[1] - len(beside))]
    if isinstance(result.descriptor, Measures):  # whose numbers every table has, in their units
        columns = []
    names = [*columns, *beside]
    metadata, measured = feature_table(result.dataset, vectors[:, : len(names)], names)
    table: Table = {**metadata, **measured}
    if wide:
        table = wide_table(metadata, measured)
    write_table(out, table)
    n_rows = len(next(iter(table.values())))
    n_bodies = counted(len(result.dataset), "body")
    print(f"{n_bodies} written to {out}, rows: {n_rows}, columns: {len(table)}")
    if columns:
        how = f"igps.descriptor({result.descriptor.name!r}).distances"
        if short:
            how = "the cosine"
        whole = f"{columns[0]} to {columns[-1]}"
        print(f"{whole} are one vector: compare it by {how}, and not column by column")
    if beside:
        print(f"{beside[0]} to {beside[-1]} are no part of it: --size ignore leaves size out")


def query(
    mesh: Path,
    gallery: Path,
    top: int = 10,
    descriptor: str | None = None,
    where: str | None = None,
    exact: bool = False,
    rerank: bool = False,
    **describing: Any,
) -> list[dict[str, Any]]:
    """List the bodies of a gallery that are most similar to one mesh.

    Args:
        mesh: the mesh file, or FILE#PART for one of several bodies in a file.
        gallery: gallery from igps gallery build, or a folder of meshes, with or without classes.
        top: number of bodies to list.
        descriptor: a name, as in igps help descriptors, or a file, or package.module:NAME of your own; by
            default that of the gallery, or pretrained for a folder.
        where: condition on columns of the gallery that listed bodies must satisfy, such as "class = 'femur' AND volume
            > 2e5".
        exact: compare with all bodies; without it, candidates in a large gallery are selected by short vectors
        rerank: re-rank the nearest 200 bodies by their common neighbours (k-reciprocal, without labels);
            the listed distances are the re-ranked ones.
    """
    from igps._progress import number_bars
    from igps.cli.gallery_commands import gallery_options
    from igps.cli.reading import Folder, check_files, described
    from igps.gallery.gallery import Gallery
    from igps.gallery.opening import is_gallery
    from igps.report.tables import text_table
    from igps.retrieval import N_RERANKED, rerank_candidates, search

    check_at_least(1, top=top)
    check_files([mesh])
    if is_gallery(gallery):
        opened = Gallery(gallery, descriptor)
        number_bars(2)
        options = gallery_options(opened, describing)
        description = _describe_body(mesh, opened.descriptor, **options)
        (matches,) = opened.nearest(description, top=top, rerank=rerank, where=where, exact=exact)
        n_missing = sum(not match.path.exists() for match in matches)
        nearest = [(match.name, match.label, match.distance) for match in matches]
    elif where is not None:
        raise ValueError(
            f"where: expected a gallery, {gallery} is a folder of meshes. See igps gallery build."
        )
    else:
        number_bars(4)
        known = described(Folder(gallery), descriptor or "pretrained", **describing)
        n_missing = 0
        # The query is described with the options of the folder
        options = {
            "paper": False,
            "signature": known.dataset.config,
            **asdict(known.dataset.reading),
        }
        description = _describe_body(mesh, known.descriptor, **{**describing, **options})
        bodies = known.dataset.bodies
        distance = known.descriptor.distances
        n_candidates = min(max(top, N_RERANKED) if rerank else top, len(bodies))
        ranking = search(description, known.descriptions, top=n_candidates, distance=distance)
        indices = ranking.indices[0]
        distances = ranking.distances[0]
        if rerank:
            distances = rerank_candidates(description, known.descriptions[indices], distance)
        labels = bodies.labels or [None] * len(bodies)
        nearest = []
        for place in distances.argsort(stable=True)[:top].tolist():
            i = int(indices[place])
            nearest.append((bodies.names[i], labels[i], float(distances[place])))
    rows: list[dict[str, Any]] = []
    cells = []
    for rank, (name, label, value) in enumerate(nearest, 1):
        rows.append({"rank": rank, "distance": value, "name": name, "class": label})
        cells.append((rank, f"{value:.3g}", name, label or "-"))
    print(text_table(("rank", "distance", "body", "class"), cells, left=("body", "class")))
    if n_missing:
        print(
            f"{n_missing} of these {len(rows)} files were moved or deleted since they were described."
        )
    return rows


def _describe_body(mesh: Path, descriptor: Descriptor, **describing: Any) -> Tensor:
    """Return the description (1, ...) of a file with one body, or of one FILE#PART."""
    from igps.cli.reading import described, print_unit_warning

    alone = {**describing, "n_workers": 1, "complete": False}
    result = described([mesh], descriptor, **alone)
    print_unit_warning(descriptor, result.dataset)
    if len(result.dataset) > 1:
        names = ", ".join(result.dataset.bodies.names[:5])
        raise ValueError(
            f"mesh: expected one body, {mesh} holds {len(result.dataset)}. Name one of them, such as {names}."
        )
    return result.descriptions


def _check_scored(bodies: Bodies, queries: str | None, needs_scores: bool) -> list[bool] | None:
    """Return which bodies are queries, None if all are; raise a ValueError if there is nothing to score."""
    if queries is not None:
        is_query = [fnmatchcase(name, queries) for name in bodies.names]
        n_queries = sum(is_query)
        if n_queries in (0, len(bodies)):
            raise ValueError(
                f"queries: expected a pattern that some bodies match, {n_queries} of {len(bodies)} match "
                f"{queries!r}. The first is called {bodies.names[0]}."
            )
        return is_query
    if needs_scores and not _has_pairs(bodies):
        raise ValueError(
            f"root: expected a class of two bodies or more, got {len(bodies)} classes of one. Put similar bodies into "
            "one class, or give --out for rankings without scores."
        )
    return None


def _has_pairs(bodies: Bodies) -> bool:
    """Return whether two bodies share a class."""
    return len(set(bodies.labels or ())) < len(bodies)


def _means(scores: RetrievalScores) -> dict[str, float]:
    return scores.mean() | (scores.single_answers() if scores.has_single_answers else {})


def _summary(result: Described) -> dict[str, Any]:
    n_used = len(result.dataset)
    n_refused = len(result.failures)
    return {
        "n_given": n_used + n_refused,
        "n_used": n_used,
        "n_refused": n_refused,
        "config": {
            "descriptor": result.name or result.descriptor.name,
            **result.dataset.config.as_dict(),
        },
    }


def _write_retrieval(
    out: Path,
    result: Described,
    summary: dict[str, Any],
    distances: dict[str, Tensor],
    is_query: list[bool] | None,
) -> None:
    import numpy as np
    import torch

    from igps._progress import Progress
    from igps.cli.reading import write_mending_notes
    from igps.report.results import write_sources
    from igps.report.tables import write_rows
    from igps.retrieval import rank

    out.mkdir(parents=True, exist_ok=True)
    names = result.dataset.bodies.names
    labels = result.dataset.bodies.labels or ()
    (out / "scores.json").write_text(json.dumps(summary, indent=2) + "\n")
    arrays: dict[str, Any] = {name: values.numpy() for name, values in distances.items()}
    np.savez_compressed(
        out / "distances.npz", names=np.array(names), labels=np.array(labels), **arrays
    )

    def ranking() -> Iterator[tuple[Any, ...]]:
        asks = torch.tensor(is_query or [False] * len(names))
        for i, order in enumerate(Progress(rank(distances["distances"]), desc="rankings")):
            if is_query is not None and not is_query[i]:
                continue
            # Much faster than access to single entries of a tensor
            row = distances["distances"][i].tolist()
            others = order[(order != i) & ~asks[order]]
            for place, j in enumerate(others.tolist(), 1):
                yield names[i], place, names[j], f"{row[j]:.6g}", int(labels[i] == labels[j])

    write_rows(out / "ranking.csv", ("query", "rank", "model", "distance", "relevant"), ranking())
    failures = [(failure.id, failure.error) for failure in result.failures]
    write_rows(out / "failures.csv", ("name", "error"), failures)
    write_mending_notes(out / "notes.csv", result.dataset)
    write_sources(out, result.dataset)
    if result.name is None:  # a descriptor whose centres were fitted to the collection has no name
        result.descriptor.save(out / "descriptor.safetensors")
