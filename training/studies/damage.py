"""Retrieval with damaged files: damaged meshes as queries against the gallery of clean meshes."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from igps._threads import one_thread
from igps.cli.reading import signatures
from igps.data.dataset import SignatureDataset
from igps.data.sources import find_bodies
from igps.descriptors import descriptor as descriptor_of
from igps.mesh.mending import Mending, mend
from igps.mesh.mesh import Mesh
from igps.nn.descriptor import Descriptor
from igps.retrieval.scores import retrieval_scores
from training.studies.altered import Alteration, Answer, describe_altered
from training.studies.damages import DAMAGES

_CLEAN = "clean"


@dataclass(frozen=True)
class DamageResult:
    """The loss of one descriptor by one damage."""

    n_given: int  # number of damaged meshes
    # Mean scores of the described damaged meshes, each as a query of the other clean meshes, from 0 to 1; empty if no
    # two of them have the same class
    scores: Mapping[str, float]
    clean: Mapping[str, float]  # scores of the same meshes before the damage
    notes: Mapping[str, str]  # why the other meshes could not be described, by name

    @property
    def usable(self) -> float:
        """The share of the damaged meshes that could be described."""
        return 1 - len(self.notes) / self.n_given

    def loss(self, score: str) -> float:
        """Return the decrease of a mean score by the damage; NaN without scores."""
        return self.clean.get(score, np.nan) - self.scores.get(score, np.nan)

    def as_dict(self) -> dict[str, Any]:
        """Return a dict for a JSON file."""
        return {
            "n_given": self.n_given,
            "usable": self.usable,
            "scores": dict(self.scores),
            "clean": dict(self.clean),
            "notes": dict(self.notes),
        }


def damage(
    dataset: SignatureDataset,
    descriptors: Sequence[Descriptor],
    *,
    damages: Sequence[str] | None = None,
    mending: Mending = "auto",
    seed: int = 0,
    n_workers: int | None = None,
) -> dict[str, dict[str, DamageResult]]:
    """Damage each mesh in each way, mend it as a file is mended, and query the other clean meshes with it.

    Args:
        dataset: labelled clean meshes, with signatures that meet the requirements of the descriptors.
        descriptors: descriptors to measure.
        damages: names in `DAMAGES`; all if None.
        mending: see `LoadOptions`.
        seed: seed of the damages.
        n_workers: number of processes; all cores if None.

    Returns:
        Results by name of the descriptor, then by damage.

    Raises:
        ValueError: the dataset has no classes, or a damage is unknown.
    """
    if dataset.bodies.labels is None:
        raise ValueError(
            "dataset: expected meshes with classes, got none. Give labels, or a folder per class."
        )
    names = list(damages or DAMAGES)
    if unknown := [name for name in names if name not in DAMAGES]:
        raise ValueError(f"damages: expected some of {', '.join(DAMAGES)}, got {unknown[0]!r}.")
    least_vertices = dataset.config.n_vertices_read
    alterations: dict[str, Alteration | None] = {
        name: partial(damaged, name, seed, mending, least_vertices) for name in names
    }
    answers = describe_altered(
        dataset, {_CLEAN: None, **alterations}, descriptors, n_workers=n_workers
    )
    clean = [row[_CLEAN] for row in answers]
    return {
        descriptor.name: {
            name: _result(descriptor, dataset, clean, [row[name] for row in answers])
            for name in names
        }
        for descriptor in descriptors
    }


def damaged(name: str, seed: int, mending: Mending, least_vertices: int, mesh: Mesh) -> Mesh:
    """Damage a mesh and mend it.

    Raises:
        MeshError: the damaged mesh cannot be mended.
    """
    vertices, faces = DAMAGES[name].apply(mesh, seed)
    return mend(
        vertices, faces, how=mending, least_vertices=least_vertices, name=f"{mesh.name} ({name})"
    )


def _result(
    descriptor: Descriptor,
    dataset: SignatureDataset,
    clean: Sequence[Mapping[str, Answer]],
    altered: Sequence[Mapping[str, Answer]],
) -> DamageResult:
    labels = dataset.bodies.labels or ()
    before, after = ([row[descriptor.name] for row in answers] for answers in (clean, altered))
    notes = {
        name: first if isinstance(first, str) else str(second)
        for name, first, second in zip(dataset.bodies.names, before, after, strict=True)
        if isinstance(first, str) or isinstance(second, str)
    }
    usable = [i for i, name in enumerate(dataset.bodies.names) if name not in notes]
    if len({labels[i] for i in usable}) == len(usable):  # no query has a relevant mesh
        return DamageResult(len(dataset), {}, {}, notes)
    gallery, queries = (
        torch.from_numpy(np.stack([answers[i] for i in usable])) for answers in (before, after)
    )
    scores = []
    for descriptions in (queries, gallery):
        with torch.inference_mode(), one_thread():
            distances = torch.cat(
                [descriptor.distances(row[None], gallery) for row in descriptions]
            )
        # A square matrix: each query leaves out the mesh of its own index
        scores.append(retrieval_scores(distances, [labels[i] for i in usable]).mean())
    return DamageResult(len(dataset), scores[0], scores[1], notes)


def damage_table(results: Mapping[str, Mapping[str, DamageResult]]) -> str:
    """Format a table: the share of described meshes and the loss of NN and FT in points, by damage and descriptor."""
    names = list(results)
    damages = list(next(iter(results.values())))
    width = max(len(name) for name in damages)
    lines = [" " * width + "".join(f"{name:>24}" for name in names)]
    lines.append(" " * width + "".join(f"{'used':>10}{'NN':>7}{'FT':>7}" for _ in names))
    notes = []
    for damage_name in damages:
        row = [results[name][damage_name] for name in names]
        cells = [
            f"{100 * x.usable:>9.0f}%{100 * x.loss('nn'):>7.1f}{100 * x.loss('ft'):>7.1f}"
            for x in row
        ]
        lines.append(f"{damage_name:<{width}}" + "".join(cells))
        for name, result in zip(names, row, strict=True):
            if result.notes:
                first = next(iter(result.notes.values()))
                notes.append(
                    f"{name}, {damage_name}: {len(result.notes)} of {result.n_given} missing; {first}"
                )
    lines.append(
        "used: share of the damaged meshes that could be described; NN, FT: points lost against the clean meshes"
    )
    lines += [f"  {damage_name}: {DAMAGES[damage_name].description}" for damage_name in damages]
    return "\n".join(lines + notes)


def damage_command(
    root: Path,
    descriptors: list[str] = ["interior", "rich", "pretrained"],  # noqa: B006 (only read)
    damages: list[str] | None = None,
    mend_by: Mending = "auto",
    every: int = 1,
    seed: int = 0,
    out: Path | None = None,
    n_workers: int | None = None,
    **reading: Any,
) -> dict[str, Any]:
    """Damage clean meshes as scanners, modelling programs and converters do, and measure what that costs retrieval.

    Each damaged mesh, mended as a file is mended, queries the clean meshes except its own. The table shows the share of
    meshes that could be described, and how many points of percent NN and FT lose against queries with clean meshes.

    Args:
        root: labelled folder of clean meshes.
        descriptors: names, or package.module:NAME of your own.
        damages: names of damages; all if not given.
        mend_by: how the damaged meshes are mended.
        every: use every n-th mesh only.
        seed: seed of the damages.
        out: folder for damage.json.
        n_workers: number of processes; all cores if not given.
    """
    if every < 1:
        raise ValueError(f"every: expected at least 1, got {every}.")
    chosen = [descriptor_of(name) for name in descriptors]
    files = find_bodies(root, labelled=True)
    files = files.subset(range(0, len(files), every))
    dataset, failures = signatures(files, chosen, n_workers=n_workers, **reading)
    results = damage(
        dataset, chosen, damages=damages, mending=mend_by, seed=seed, n_workers=n_workers
    )
    print(damage_table(results))
    for failure in failures:
        print(f"not used: {failure.error}")
    summary = {
        "damages": {name: kind.description for name, kind in DAMAGES.items()},
        "results": {
            name: {key: x.as_dict() for key, x in row.items()} for name, row in results.items()
        },
        "config": dataset.config.as_dict(),
    }
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "damage.json").write_text(json.dumps(summary, indent=2) + "\n")
        print(f"written to {out}")
    return summary
