"""What damaged files cost: damaged meshes as queries against the gallery of their clean twins."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from igps._parallel import one_thread
from igps.cli.reading import signatures
from igps.data.dataset import SignatureDataset
from igps.data.sources import find_bodies
from igps.descriptors import descriptor as descriptor_of
from igps.mesh.mending import Mending, mend
from igps.mesh.mesh import Mesh
from igps.nn.descriptor import Descriptor
from igps.retrieval.scores import retrieval_scores
from training.studies.altered import Answer, Way, describe_altered
from training.studies.damages import DAMAGES

_CLEAN = "clean"


@dataclass(frozen=True)
class DamageResult:
    """What one damage costs one descriptor."""

    n_given: int  # meshes that were damaged
    # Means over the damaged meshes that could be described, each as a query of the clean others, fractions; none where
    # no two of them are of one class
    scores: Mapping[str, float]
    clean: Mapping[str, float]  # the same of their clean twins
    notes: Mapping[str, str]  # why others could not be described, by name

    @property
    def usable(self) -> float:
        """Share of the damaged meshes that could be described."""
        return 1 - len(self.notes) / self.n_given

    def loss(self, score: str) -> float:
        """By how much a mean score is lower than that of the clean twins; NaN without scores."""
        return self.clean.get(score, np.nan) - self.scores.get(score, np.nan)

    def as_dict(self) -> dict[str, Any]:
        """For a JSON file."""
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
    """Damage every mesh in every way of `DAMAGES`, mend it as a file would be, and query the clean others with it.

    Args:
        dataset: labelled clean meshes, their signatures with all that the descriptors need.
        descriptors: to be measured.
        damages: names; all if None.
        mending: see `LoadOptions`.
        seed: of the damages.
        n_workers: processes; all cores if None.

    Returns:
        By descriptor, by damage.

    Raises:
        ValueError: no classes, or an unknown damage.
    """
    if dataset.bodies.labels is None:
        raise ValueError("dataset: expected meshes with classes, got none. Give labels, or a folder per class.")
    names = list(damages or DAMAGES)
    if unknown := [name for name in names if name not in DAMAGES]:
        raise ValueError(f"damages: expected some of {', '.join(DAMAGES)}, got {unknown[0]!r}.")
    least = dataset.config.n_vertices_read
    ways: dict[str, Way | None] = {name: partial(damaged, name, seed, mending, least) for name in names}
    found = describe_altered(dataset, {_CLEAN: None, **ways}, descriptors, n_workers=n_workers)
    clean = [of[_CLEAN] for of in found]
    spoiled = {name: [of[name] for of in found] for name in names}
    return {
        one.name: {name: _result(one, dataset, clean, answers) for name, answers in spoiled.items()}
        for one in descriptors
    }


def damaged(name: str, seed: int, mending: Mending, least_vertices: int, mesh: Mesh) -> Mesh:
    """The mesh damaged and mended again.

    Raises:
        MeshError: it could not be mended.
    """
    vertices, faces = DAMAGES[name].apply(mesh, seed)
    return mend(vertices, faces, how=mending, least_vertices=least_vertices, name=f"{mesh.name} ({name})")


def _result(
    descriptor: Descriptor,
    dataset: SignatureDataset,
    clean: Sequence[Mapping[str, Answer]],
    spoiled: Sequence[Mapping[str, Answer]],
) -> DamageResult:
    labels = dataset.bodies.labels or ()
    before, after = ([of[descriptor.name] for of in answers] for answers in (clean, spoiled))
    notes = {
        name: one if isinstance(one, str) else str(other)
        for name, one, other in zip(dataset.bodies.names, before, after, strict=True)
        if isinstance(one, str) or isinstance(other, str)
    }
    kept = [i for i, name in enumerate(dataset.bodies.names) if name not in notes]
    if len({labels[i] for i in kept}) == len(kept):
        # Nothing is left, or nothing that could be found.
        return DamageResult(len(dataset), {}, {}, notes)
    gallery, queries = (torch.from_numpy(np.stack([answers[i] for i in kept])) for answers in (before, after))
    scores = []
    for one in (queries, gallery):
        with torch.inference_mode(), one_thread():
            distances = torch.cat([descriptor.distances(row[None], gallery) for row in one])
        # Square: each query leaves out its own twin.
        scores.append(retrieval_scores(distances, [labels[i] for i in kept]).mean())
    return DamageResult(len(dataset), scores[0], scores[1], notes)


def damage_table(results: Mapping[str, Mapping[str, DamageResult]]) -> str:
    """One line a damage, of each descriptor the share of meshes described and the loss of NN and FT in points."""
    names = list(results)
    damages = list(next(iter(results.values())))
    width = max(len(name) for name in damages)
    lines = [" " * width + "".join(f"{name:>24}" for name in names)]
    lines.append(" " * width + "".join(f"{'used':>10}{'NN':>7}{'FT':>7}" for _ in names))
    notes = []
    for way in damages:
        found = [results[name][way] for name in names]
        cells = [f"{100 * one.usable:>9.0f}%{100 * one.loss('nn'):>7.1f}{100 * one.loss('ft'):>7.1f}" for one in found]
        lines.append(f"{way:<{width}}" + "".join(cells))
        for name, one in zip(names, found, strict=True):
            if one.notes:
                first = next(iter(one.notes.values()))
                notes.append(f"{name}, {way}: {len(one.notes)} of {one.n_given} missing; {first}")
    lines.append(
        "used: share of the damaged meshes that could be described; NN, FT: points lost against the clean twins"
    )
    lines += [f"  {way}: {DAMAGES[way].description}" for way in damages]
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

    Every damaged mesh, mended as a file would be, queries the clean meshes but its own twin. The table tells the share
    that could be described, and the loss of NN and FT against the clean twins in points of percent.

    Args:
        root: labelled folder of clean meshes.
        descriptors: names, or package.module:NAME of your own.
        damages: which of them; all if not given.
        mend_by: how the damaged meshes are mended.
        every: take every so many of the meshes.
        seed: of the damages.
        out: folder for damage.json.
        n_workers: processes that compute; all cores if not given.
    """
    if every < 1:
        raise ValueError(f"every: expected at least 1, got {every}.")
    chosen = [descriptor_of(name) for name in descriptors]
    files = find_bodies(root, labelled=True)
    files = files.subset(range(0, len(files), every))
    dataset, failures = signatures(files, chosen, n_workers=n_workers, **reading)
    found = damage(dataset, chosen, damages=damages, mending=mend_by, seed=seed, n_workers=n_workers)
    print(damage_table(found))
    for failure in failures:
        print(f"not used: {failure.error}")
    summary = {
        "damages": {name: one.description for name, one in DAMAGES.items()},
        "results": {name: {way: one.as_dict() for way, one in of.items()} for name, of in found.items()},
        "config": dataset.config.as_dict(),
    }
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "damage.json").write_text(json.dumps(summary, indent=2) + "\n")
        print(f"written to {out}")
    return summary
