"""The command line: `igps retrieve`, `igps extract`, `igps query`, `igps demo`."""

from __future__ import annotations

import csv
import json
import logging
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jsonargparse import ArgumentParser
from torch import Tensor

from igps.data.dataset import Failure, SignatureDataset
from igps.data.shapes import ArticulatedShapes
from igps.data.sources import MeshFiles, find_meshes
from igps.geometry.mesh import Component
from igps.geometry.signature import SignatureConfig
from igps.nn.descriptor import VolumetricDescriptor
from igps.nn.extraction import describe
from igps.retrieval import RetrievalScores, chi_square, rank, retrieval_scores, search

DescriptorName = Literal["interior", "gps"]

_FLAGS = {
    "paper": "use the parameters of Rustamov 2010: as the defaults, but the grid is never refined",
    "repair": "weld vertices, drop degenerate, duplicate and unused elements, and orient the faces of each mesh",
    "allow_open": "accept surfaces with holes",
    "strict": "stop at the first mesh that cannot be used instead of skipping it",
}
_POSITIONAL: dict[str, tuple[str, str | None, str]] = {
    "retrieve": ("root", None, "folder with one subfolder per class, or with meshes and a labels.csv (file,label)"),
    "extract": ("meshes", "+", "mesh files, or one folder"),
    "query": ("mesh", None, "the mesh to look for"),
}
_TITLES = dict(nn="NN", ft="FT", st="ST", e="E", dcg="DCG", adr="ADR", adr_self="ADR self", map="mAP")  # noqa: C408


def retrieve(
    root: Path,
    descriptor: DescriptorName = "interior",
    out: Path | None = None,
    **reading: Any,
) -> None:
    """Query a labelled collection with each of its meshes and print the retrieval scores.

    Every mesh is compared with all others (leave-one-out) by the chi-square distance of their histograms.

    Args:
        root: folder with one subfolder per class, or with meshes and a labels.csv (columns file,label).
        descriptor: interior is the volumetric descriptor of Rustamov 2010, gps its surface counterpart.
        out: folder for scores.json, ranking.csv, distances.npz, and failures.csv if a mesh could not be used.
    """
    files = find_meshes(root)
    if files.labels is None:
        raise ValueError(f"{root}: no classes found. Expected one folder per class, or a labels.csv (file,label).")
    dataset, failures = _signatures(files, **reading)
    histograms = describe(dataset, _descriptor(descriptor), progress=True)
    distances = chi_square(histograms, histograms)
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

    The file is a NumPy archive: `features` (N, pairs of potential classes, bins) and `names` (N,), and `labels` (N,)
    where the meshes come from a folder with classes.

    Args:
        meshes: mesh files, or one folder.
        out: the archive, a file ending in .npz.
        descriptor: interior is the volumetric descriptor of Rustamov 2010, gps its surface counterpart.
    """
    dataset, failures = _signatures(meshes[0] if len(meshes) == 1 else meshes, **reading)
    features = describe(dataset, _descriptor(descriptor), progress=True).numpy()
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
        descriptor: interior is the volumetric descriptor of Rustamov 2010, gps its surface counterpart.
    """
    if top < 1:
        raise ValueError(f"top: expected at least 1, got {top}.")
    needle, _ = _signatures([mesh], **reading)
    dataset, _ = _signatures(find_meshes(gallery), **reading)
    wanted = describe(needle, _descriptor(descriptor))
    histograms = describe(dataset, _descriptor(descriptor), progress=True)
    found = search(wanted, histograms, top=min(top, len(dataset)))
    width = max(len(dataset.files.names[i]) for i in found.indices[0].tolist())
    print(f"{'rank':>4}  {'distance':>8}  {'mesh':<{width}}  class")
    for place, (i, distance) in enumerate(zip(found.indices[0].tolist(), found.distances[0].tolist(), strict=True), 1):
        label = dataset.files.labels[i] if dataset.files.labels is not None else "-"
        print(f"{place:>4}  {distance:>8.4f}  {dataset.files.names[i]:<{width}}  {label}")


def demo(out: Path = Path("build/demo"), workers: int | None = None) -> None:
    """Make a small benchmark of articulated shapes, run the retrieval on it, and save a figure of ranked results.

    Args:
        out: folder for the meshes, the results of `igps retrieve`, and ranked.png.
        workers: processes that compute signatures; all cores if not given.
    """
    from igps.figures import ranked_results

    shapes = ArticulatedShapes(n_classes=8, n_per_class=10)
    shapes.write(out / "shapes", progress=True)
    retrieve(out / "shapes", out=out, cache=out / "cache", workers=workers)
    ranked_results(out / "shapes", out / "ranking.csv", out / "ranked.png")
    print(f"ranked results of one query per class: {out / 'ranked.png'}")


def format_scores(scores: RetrievalScores) -> str:
    """The scores as a table in percent: one line over all queries, one per class."""
    columns = {name: title for name, title in _TITLES.items() if name in scores.mean()}
    rows = {"all": scores.mean(), **{str(label): values for label, values in scores.per_class().items()}}
    width = max(len(name) for name in rows)
    lines = [" " * width + "".join(f"{title:>10}" for title in columns.values())]
    lines += [f"{name:<{width}}" + "".join(f"{100 * row[key]:>10.1f}" for key in columns) for name, row in rows.items()]
    lines.append(f"percent, {scores.n_queries} queries, each against all others")
    if scores.n_excluded:
        lines.append(f"{scores.n_excluded} meshes are the only one of their class and were not scored as queries")
    return "\n".join(lines)


def main() -> None:
    """Entry point of the `igps` command."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    parser = _parser()
    arguments = parser.instantiate(parser.parse_args())
    command, options = arguments.subcommand, arguments[arguments.subcommand].as_dict()
    try:
        _COMMANDS[command](**options)
    except (ValueError, OSError, RuntimeError, ImportError) as error:
        # Expected of bad input, and said in full by the message; a traceback would bury it.
        print(f"igps: {error}", file=sys.stderr)
        sys.exit(1)


def _parser() -> ArgumentParser:
    """Options from the signatures and docstrings of the commands; flags and lists as a shell user writes them."""
    parser = ArgumentParser(prog="igps", description="Volumetric shape retrieval by interior Global Point Signatures.")
    commands = parser.add_subcommands(required=True)
    for name, function in _COMMANDS.items():
        summary, _, rest = (function.__doc__ or "").partition("\n")
        details = rest.partition("Args:")[0]
        command = ArgumentParser(description=summary + "\n" + details)
        positional = _POSITIONAL.get(name)
        if positional is not None:
            argument, count, meaning = positional
            command.add_argument(argument, nargs=count, type=Path, help=meaning)
        command.add_function_arguments(function, skip={*_FLAGS, *(positional or ())[:1]})
        if name != "demo":
            for flag, meaning in _FLAGS.items():
                command.add_argument(f"--{flag}", action="store_true", help=meaning)
        commands.add_subcommand(name, command, help=summary)
    return parser


def _signatures(
    source: Path | Sequence[Path] | MeshFiles,
    cache: Path | None = None,
    signature: SignatureConfig = SignatureConfig(),  # noqa: B008 (frozen)
    paper: bool = False,
    repair: bool = False,
    component: Component | None = None,
    allow_open: bool = False,
    strict: bool = False,
    workers: int | None = None,
) -> tuple[SignatureDataset, list[Failure]]:
    """The meshes whose signatures are in the cache, after computing what was missing; and those that failed.

    The parameters are options of every command that reads meshes.

    Args:
        source: a folder, files, or what was found in a folder.
        cache: folder where computed signatures are kept; the user's cache directory if not given.
        signature: parameters of the signatures.
        component: largest keeps only the largest connected component of each mesh.
        workers: processes that compute signatures; all cores if not given.
        paper, repair, allow_open, strict: see `_FLAGS`.
    """
    if paper:
        if signature != SignatureConfig():
            raise ValueError("paper: expected no other parameters of the signatures beside it. Leave one out.")
        signature = SignatureConfig.paper()
    dataset = SignatureDataset(source, signature, cache, repair=repair, component=component, allow_open=allow_open)
    failures = dataset.precompute(n_workers=workers, strict=strict)
    if len(failures) == len(dataset):
        raise ValueError(f"none of {len(dataset)} meshes could be used; the first: {failures[0].error}")
    return dataset.usable(failures), failures


def _descriptor(name: DescriptorName) -> VolumetricDescriptor:
    return VolumetricDescriptor.paper("interior" if name == "interior" else "surface")


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
    failures_file = out / "failures.csv"
    failures_file.unlink(missing_ok=True)
    if failures:
        with failures_file.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["file", "error"])
            writer.writerows([failure.id, failure.error] for failure in failures)


_COMMANDS: dict[str, Callable[..., None]] = {"retrieve": retrieve, "extract": extract, "query": query, "demo": demo}


if __name__ == "__main__":
    main()
