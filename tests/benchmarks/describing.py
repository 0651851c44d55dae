"""What describing a stored signature costs, by whichever igps is on the path: of now, or of commit 8140bb3.

    python describing.py SIGNATURE.npz

For each descriptor named on a line of its input it tells the seconds of processor time.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

try:
    from igps.signature.signature import Samples, Signature, SignatureConfig
except ModuleNotFoundError:  # its place in commit 8140bb3
    from igps.geometry.signature import Samples, Signature, SignatureConfig

ROOMS = ("interior", "surface")


def save(signature: Signature, path: Path) -> None:
    """Write what both versions know of a signature."""
    arrays: dict[str, Any] = {"eigenvalues": signature.eigenvalues, "scalars": [signature.area, signature.volume]}
    for room in ROOMS:
        samples: Samples = getattr(signature, room)
        arrays |= {f"{room} points": samples.points, f"{room} eigenfunctions": samples.eigenfunctions}
        arrays |= {f"{room} attribute {name}": values for name, values in samples.attributes.items()}
    np.savez(path, **arrays)


def load(path: Path) -> Signature:
    with np.load(path) as arrays:
        rooms = []
        for room in ROOMS:
            prefix = f"{room} attribute "
            names = [name.removeprefix(prefix) for name in arrays.files if name.startswith(prefix)]
            attributes = {name: arrays[prefix + name] for name in names}
            rooms.append(Samples(arrays[f"{room} points"], arrays[f"{room} eigenfunctions"], attributes))
        area, volume = arrays["scalars"].tolist()
        return Signature(arrays["eigenvalues"], *rooms, area, volume, SignatureConfig())


def main() -> None:
    signature = load(Path(sys.argv[1]))
    torch.set_num_threads(1)
    if importlib.util.find_spec("igps.descriptors") is not None:
        make, collate = importlib.import_module("igps").descriptor, importlib.import_module("igps").collate
    else:
        presets = importlib.import_module("igps.nn.presets")
        collate = importlib.import_module("igps.data.dataset").collate

        def make(name: str) -> Any:
            return presets.preset(name).make()

    made: dict[str, Any] = {}
    with torch.inference_mode():
        for line in sys.stdin:
            name = line.strip()
            if name not in made:
                made[name] = make(name).eval()
                made[name](collate([signature]))  # with all that is loaded and compiled the first time
            start = time.process_time()
            made[name](collate([signature]))
            print(time.process_time() - start, flush=True)


if __name__ == "__main__":
    main()
