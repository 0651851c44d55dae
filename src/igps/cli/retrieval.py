"""`igps retrieve`, `igps extract` and `igps query`."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from igps.cli.reading import labelled_meshes, preset_signatures, write_failures
from igps.data.dataset import Failure, SignatureDataset
from igps.data.sources import find_meshes
from igps.nn.extraction import describe
from igps.nn.presets import DescriptorName, preset
from igps.retrieval import RetrievalScores, rank, retrieval_scores, search

TITLES = dict(nn="NN", ft="FT", st="ST", e="E", dcg="DCG", adr="ADR", adr_self="ADR self", map="mAP")  # noqa: C408
"""Column titles of the scores, by name."""


def retrieve(
    root: Path,
    descriptor: DescriptorName = "interior",
    out: Path | None = None,
    **reading: Any,
) -> None:
    """Query a labelled collection with each of its meshes and print the retrieval scores.

    Every mesh is compared with all others (leave-one-out) by the chi-square distance of their histograms, or the cosine
    distance of pretrained embeddings.

    Args:
        root: folder with one subfolder per class, or with meshes and a labels.csv (columns file,label).
        descriptor: interior is the volumetric descriptor of Rustamov 2010, gps its surface counterpart; multiscale and
            rich have further dimensions, pretrained a metric learned from generated shapes.
        out: folder for scores.json, ranking.csv, distances.npz, and failures.csv if a mesh could not be used.
    """
    chosen = preset(descriptor)
    dataset, failures = preset_signatures(chosen, labelled_meshes(root), **reading)
    descriptors = describe(dataset, chosen.make(), progress=True)
    distances = chosen.distance(descriptors, descriptors)
    scores = retrieval_scores(distances, dataset.files.labels or ())
    print(format_scores(scores))
    if failures:
        print(f"{len(failures)} of {len(failures) + len(dataset)} meshes could not be used.")
    if out is not None:
        _write_retrieval(out, dataset, descriptor, distances, scores, failures)
        print(f"written to {out}")


def extract(
    meshes: list[Path],
    out: Path,
    descriptor: DescriptorName = "interior",
    **reading: Any,
) -> None:
    """Write the descriptors of meshes to a file, for use in any classifier.

    The file is a NumPy archive: `features` (N, pairs of potential classes, bins), or (N, cells) of descriptors with
    further dimensions, `names` (N,), and `labels` (N,) where the meshes come from a folder with classes.

    Args:
        meshes: mesh files, or one folder.
        out: the archive, a file ending in .npz.
        descriptor: interior is the volumetric descriptor of Rustamov 2010, gps its surface counterpart; multiscale and
            rich have further dimensions, pretrained a metric learned from generated shapes.
    """
    chosen = preset(descriptor)
    source = meshes[0] if len(meshes) == 1 else meshes
    dataset, failures = preset_signatures(chosen, source, **reading)
    features = describe(dataset, chosen.make(), progress=True).numpy()
    arrays: dict[str, Any] = {"features": features, "names": np.array(dataset.files.names)}
    if dataset.files.labels is not None:
        arrays["labels"] = np.array(dataset.files.labels)
    out.parent.mkdir(parents=True, exist_ok=True)
    with out.open("wb") as file:  # given a name, NumPy would append .npz to it
        np.savez_compressed(file, **arrays)
    print(f"{len(features)} descriptors of shape {features.shape[1:]} written to {out}; {len(failures)} meshes skipped")


def query(
    mesh: Path,
    gallery: Path,
    top: int = 10,
    descriptor: DescriptorName = "interior",
    **reading: Any,
) -> None:
    """List the meshes of a gallery that are most similar to one mesh.

    Args:
        mesh: the mesh to look for.
        gallery: folder of meshes, with or without classes.
        top: how many to list.
        descriptor: interior is the volumetric descriptor of Rustamov 2010, gps its surface counterpart; multiscale and
            rich have further dimensions, pretrained a metric learned from generated shapes.
    """
    if top < 1:
        raise ValueError(f"top: expected at least 1, got {top}.")
    chosen = preset(descriptor)
    needle, _ = preset_signatures(chosen, [mesh], **reading)
    dataset, _ = preset_signatures(chosen, find_meshes(gallery), **reading)
    module = chosen.make()
    wanted, descriptors = describe(needle, module), describe(dataset, module, progress=True)
    found = search(wanted, descriptors, top=min(top, len(dataset)), distance=chosen.distance)
    width = max(len(dataset.files.names[i]) for i in found.indices[0].tolist())
    print(f"{'rank':>4}  {'distance':>8}  {'mesh':<{width}}  class")
    for place, (i, distance) in enumerate(zip(found.indices[0].tolist(), found.distances[0].tolist(), strict=True), 1):
        label = dataset.files.labels[i] if dataset.files.labels is not None else "-"
        print(f"{place:>4}  {distance:>8.4f}  {dataset.files.names[i]:<{width}}  {label}")


def format_scores(scores: RetrievalScores) -> str:
    """The scores as a table in percent: one line over all queries, one per class."""
    columns = {name: title for name, title in TITLES.items() if name in scores.mean()}
    rows = {"all": scores.mean(), **{str(label): values for label, values in scores.per_class().items()}}
    width = max(len(name) for name in rows)
    lines = [" " * width + "".join(f"{title:>10}" for title in columns.values())]
    lines += [f"{name:<{width}}" + "".join(f"{100 * row[key]:>10.1f}" for key in columns) for name, row in rows.items()]
    lines.append(f"percent, {scores.n_queries} queries, each against all others")
    if scores.n_excluded:
        lines.append(f"{scores.n_excluded} meshes are the only one of their class and were not scored as queries")
    return "\n".join(lines)


def _write_retrieval(
    out: Path,
    dataset: SignatureDataset,
    descriptor: DescriptorName,
    distances: Tensor,
    scores: RetrievalScores,
    failures: Sequence[Failure],
) -> None:
    out.mkdir(parents=True, exist_ok=True)
    names, labels = dataset.files.names, dataset.files.labels or ()
    summary = {
        **scores.mean(),
        "n_queries": scores.n_queries,
        "per_class": {str(label): values for label, values in scores.per_class().items()},
        "config": {"descriptor": descriptor, **dataset.config.as_dict()},
    }
    (out / "scores.json").write_text(json.dumps(summary, indent=2) + "\n")
    np.savez_compressed(
        out / "distances.npz", distances=distances.numpy(), names=np.array(names), labels=np.array(labels)
    )
    others = ~torch.eye(len(names), dtype=torch.bool)
    with (out / "ranking.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["query", "rank", "model", "distance", "relevant"])
        for i, order in enumerate(rank(distances)):
            for place, j in enumerate(order[others[i][order]].tolist(), 1):
                row = [names[i], place, names[j], f"{float(distances[i, j]):.6g}", int(labels[i] == labels[j])]
                writer.writerow(row)
    rows = [(failure.id, failure.error) for failure in failures]
    write_failures(out / "failures.csv", ("file", "error"), rows)
