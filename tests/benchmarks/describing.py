"""Cost of describing a stored signature, by the igps on the path: the current version, or that of commit 8140bb3.

    python describing.py SIGNATURE.npz

Each line of standard input names a descriptor. The script prints the seconds of processor time for each.
"""

import importlib
import importlib.util
import sys
import time
from pathlib import Path

import numpy as np
import torch

try:
    from igps.signature.signature import Samples, Signature, SignatureConfig
except ModuleNotFoundError:  # its place in commit 8140bb3
    from igps.geometry.signature import Samples, Signature, SignatureConfig

KINDS = ("interior", "surface")


def save(signature, path):
    """Write the fields of a signature that both versions have."""
    arrays = {
        "eigenvalues": signature.eigenvalues,
        "scalars": [signature.area, signature.volume],
    }
    for kind in KINDS:
        samples = getattr(signature, kind)
        arrays |= {
            f"{kind} points": samples.points,
            f"{kind} eigenfunctions": samples.eigenfunctions,
        }
        arrays |= {
            f"{kind} attribute {name}": values for name, values in samples.attributes.items()
        }
    np.savez(path, **arrays)


def load(path):
    with np.load(path) as arrays:
        samples = []
        for kind in KINDS:
            prefix = f"{kind} attribute "
            names = [name.removeprefix(prefix) for name in arrays.files if name.startswith(prefix)]
            attributes = {name: arrays[prefix + name] for name in names}
            samples.append(
                Samples(arrays[f"{kind} points"], arrays[f"{kind} eigenfunctions"], attributes)
            )
        area, volume = arrays["scalars"].tolist()
        return Signature(arrays["eigenvalues"], *samples, area, volume, SignatureConfig())


def main():
    signature = load(Path(sys.argv[1]))
    torch.set_num_threads(1)
    if importlib.util.find_spec("igps.descriptors") is not None:
        make = importlib.import_module("igps").descriptor
        collate = importlib.import_module("igps").collate
    else:
        presets = importlib.import_module("igps.nn.presets")
        collate = importlib.import_module("igps.data.dataset").collate

        def make(name):
            return presets.preset(name).make()

    made = {}
    with torch.inference_mode():
        for line in sys.stdin:
            name = line.strip()
            if name not in made:
                made[name] = make(name).eval()
                made[name](collate([signature]))  # the first call loads and compiles functions
            start = time.process_time()
            made[name](collate([signature]))
            print(time.process_time() - start, flush=True)


if __name__ == "__main__":
    main()
