"""Compressed streams with one to eight changed bytes: the body is as it was, refused, or has a note."""

import logging
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
from outcome import Row

from igps.fields.volumes.label_volume import read_label_volume
from igps.mesh.errors import MeshError
from igps.mesh.loading import read_surface

sys.path.append(str(Path(__file__).parents[1]))
from damaged_streams import WRITERS, changed, start_of_stream, stored

SEED = 20261129
KINDS = ("equal", "refused", "note", "wrong")


def body_in(path):
    """Return the arrays that make a body, and the notes; voxels where the file has voxels."""
    if path.name.startswith("mask"):
        volume = read_label_volume(path)
        return [volume.affine.tobytes(), *map(bytes, volume.layers)], volume.notes
    raw = read_surface(path)
    return [raw.vertices.tobytes(), raw.faces.tobytes()], raw.notes


def verdict(path, content, sound):
    """Return one of `KINDS` for a file that gets this content."""
    stored(path).write_bytes(content)
    try:
        body, notes = body_in(path)
    except MeshError:
        return "refused"
    if body == sound:
        return "equal"
    return "note" if notes else "wrong"


def examine(name, n_cases):
    """Change the stream of one format `n_cases` times."""
    start = time.monotonic()
    counts = dict.fromkeys(KINDS, 0)
    missed = []
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(folder) / name
        WRITERS[name](path)
        sound, _ = body_in(path)
        content = stored(path).read_bytes()
        first = start_of_stream(name, content)
        for number in range(n_cases):
            generator = np.random.default_rng([SEED, number])
            kind = verdict(path, changed(content, first, generator), sound)
            counts[kind] += 1
            if kind == "wrong":
                missed.append(f"{name}, case {number}: another body in silence")
    measured = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    target = "equal, refused, or a note"
    seconds = time.monotonic() - start
    return Row("changed streams", name, n_cases, target, measured, missed, seconds=seconds)


def campaign(n_cases):
    """Change `n_cases` streams of each format."""
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # it logs each of thousands of faults
    return [examine(name, n_cases) for name in WRITERS]
