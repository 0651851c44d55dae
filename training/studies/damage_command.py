"""`python -m training.study damage`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from igps.cli.reading import signatures
from igps.data.sources import find_bodies
from igps.descriptors import descriptor as descriptor_of
from igps.mesh.mending import Mending
from training.studies.damage import damage as measure
from training.studies.damages import DAMAGES
from training.studies.tables import damage_table


def damage(
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
    found = measure(dataset, chosen, damages=damages, mending=mend_by, seed=seed, n_workers=n_workers)
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
