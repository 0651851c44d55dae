"""Where the meshes of a folder of results lie and how they were read, so that their page can be made afterwards."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from igps.data.dataset import SignatureDataset
from igps.data.sources import Bodies, file_of
from igps.mesh.options import LoadOptions
from igps.signature.signature import SignatureConfig

MESHES_FILE = "meshes.json"
_FORMAT = "igps-meshes-1"


def write_sources(folder: Path, dataset: SignatureDataset) -> None:
    """Write meshes.json: of each body its name in the results, file, part, columns; reading, signature, cache."""
    pipeline, files = dataset.pipeline, dataset.bodies
    summary = {
        "format": _FORMAT,
        "meshes": [
            {"file": name, "path": str(body.path.resolve()), "part": body.part}
            for name, body in zip(files.names, files, strict=True)
        ],
        "columns": files.columns,
        "reading": pipeline.reading.as_dict(),
        "signature": asdict(pipeline.config),
        "cache_dir": str(pipeline.cache_dir.resolve()),
    }
    (folder / MESHES_FILE).write_text(json.dumps(summary, indent=1) + "\n")


def read_sources(folder: Path, meshes: Path | None = None) -> SignatureDataset | None:
    """The meshes of a folder of results, None where it does not tell them; `meshes` is where they were moved to."""
    path = folder / MESHES_FILE
    if not path.is_file():
        return None
    try:
        summary: dict[str, Any] = json.loads(path.read_text())
        if summary["format"] != _FORMAT:
            raise ValueError(f"its format is {summary['format']!r}")
        names = tuple(str(one["file"]) for one in summary["meshes"])
        parts = tuple(one.get("part") for one in summary["meshes"])
        if meshes is None:
            paths = tuple(Path(one["path"]) for one in summary["meshes"])
        else:
            paths = tuple(meshes / file_of(name, part) for name, part in zip(names, parts, strict=True))
        columns = {str(name): tuple(values) for name, values in summary.get("columns", {}).items()}
        signature = {**summary["signature"], "attributes": tuple(summary["signature"]["attributes"])}
        bodies, reading = Bodies(paths, names, None, parts, columns), LoadOptions(**summary["reading"])
        return SignatureDataset(bodies, SignatureConfig(**signature), summary["cache_dir"], reading=reading)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: expected the format {_FORMAT} ({error}). Run the command again.") from error
