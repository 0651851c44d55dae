"""`igps explain`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from igps.analysis.explanation import KINDS, Explanation, explain_groups, on_surface
from igps.analysis.explanation import explain as explain_pair
from igps.analysis.groups import squared_distances
from igps.cli.reading import Folder, described
from igps.data.dataset import SignatureDataset
from igps.descriptors import descriptor as descriptor_of
from igps.mesh.mesh import Mesh
from igps.nn.descriptor import EmbeddedDescriptor
from igps.report.answers import explanation_figure, write_answer


def explain(
    meshes: list[Path], descriptor: str = "pretrained", level: float = 0.05, out: Path | None = None, **reading: Any
) -> dict[str, Any]:
    """Tell where two bodies differ, or two groups of bodies: their distance, shared out and painted on both.

    Args:
        meshes: two files, or a folder with two classes.
        descriptor: of histograms, such as interior, rich or pretrained.
        level: of two groups, only cells of the histograms count whose means differ by more than chance does, any false
            one with this probability.
        out: folder for explain.csv, the shares of the histograms; explain_samples.csv, those of the samples; and both
            bodies painted from two sides as explain.svg and explain.png.
    """
    module = descriptor_of(descriptor)
    if len(meshes) == 1 and meshes[0].is_dir():
        inner = module.descriptor if isinstance(module, EmbeddedDescriptor) else module
        bodies = described(Folder(meshes[0], labelled=True), inner, **reading)
        dataset, descriptions, labels = bodies.dataset, bodies.descriptions, np.array(bodies.dataset.bodies.labels)
        classes = sorted(set(labels))
        if len(classes) != 2:
            raise ValueError(f"meshes: expected a folder of two classes, got {len(classes)}.")
        members = [np.flatnonzero(labels == name) for name in classes]
        squares = squared_distances(descriptions.flatten(1).double().sqrt().numpy())
        chosen = [int(own[squares[np.ix_(own, own)].sum(axis=1).argmin()]) for own in members]  # the medoids
        batches = [dataset.batch([i]) for i in chosen]
        found, kept = explain_groups(module, descriptions[members[0]], descriptions[members[1]], batches, level=level)
        print(f"{int(kept.sum())} of {len(kept)} cells differ by more than chance; painted: the middle of each group")
    else:
        dataset, chosen = described(meshes, module, **{**reading, "strict": True}).dataset, [0, 1]
        if len(dataset) != 2:
            raise ValueError(f"meshes: expected two bodies, got {len(dataset)}. Name two files, or FILE#PART.")
        found = explain_pair(module, *(dataset.batch([i]) for i in chosen))
    names = [dataset.bodies.names[i] for i in chosen]
    print(f"{' and '.join(names)}: {found.distance:.4g} by {descriptor}: {found.told()}")
    painted = [_painted(dataset, i, found, place) for place, i in enumerate(chosen)]
    for name, (_, values) in zip(names, painted, strict=True):
        print(f"{name}: half of what is its own lies on {_half(values):.0%} of its surface")
    parts = [{"histogram": name, "share": share} for name, share in found.parts.items()]
    if out is not None:
        write_answer(out, "explain_samples", _sample_rows(dataset, chosen, found))
        write_answer(out, "explain", parts, explanation_figure(painted))
        print(f"written to {out}")
    return {"bodies": names, "distance": found.distance, "shares": parts}


def _painted(dataset: SignatureDataset, i: int, found: Explanation, place: int) -> tuple[Mesh, Any]:
    """A body, and what each of its faces has of the difference."""
    mesh, signature = dataset.mesh(i), dataset[i].signature
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    samples = {kind: getattr(signature, kind).points for kind in KINDS}
    return mesh, on_surface((found.places or found.samples)[place], samples, centres)


def _half(values: Any) -> float:
    """The smallest share of places that holds half of all that is positive."""
    positive = np.sort(np.maximum(values, 0))[::-1]
    total = positive.sum()
    return float((np.searchsorted(np.cumsum(positive), total / 2) + 1) / len(values)) if total else 0.0


def _sample_rows(dataset: SignatureDataset, chosen: list[int], found: Explanation) -> list[dict[str, Any]]:
    return [
        {"body": dataset.bodies.names[i], "samples": kind, **dict(zip("xyz", point, strict=True)),
         "share": float(share), "share_by_place": float(placed)}
        for i, shares, places in zip(chosen, found.samples, found.places or found.samples, strict=True)
        for kind in KINDS
        for point, share, placed in zip(
            getattr(dataset[i].signature, kind).points.tolist(), shares[kind], places[kind], strict=True
        )
    ]  # fmt: skip
