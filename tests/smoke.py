"""What an installed package must do: python tests/smoke.py VERSION FOLDER, from outside of the tree.

The body is a box, of which area, volume and distances are known; nothing but the dependencies is needed.
"""

from __future__ import annotations

import importlib.metadata
import itertools
import sys
import tempfile
from pathlib import Path

import numpy as np
import trimesh

import igps
from igps.cli import main

version, there = sys.argv[1:]
assert importlib.metadata.version("interior-gps") == version
assert Path(igps.__file__).is_relative_to(Path(there).resolve()), igps.__file__

with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    for (kind, length), number in itertools.product({"long": 3.0, "short": 1.0}.items(), range(2)):
        box = trimesh.creation.box([1.0, 1.2 + 0.1 * number, length])
        for _ in range(4):
            box = box.subdivide()
        (folder / "boxes" / kind).mkdir(parents=True, exist_ok=True)
        box.export(folder / "boxes" / kind / f"{number}.off")
    config = igps.SignatureConfig(n_eigenpairs=250)
    dataset = igps.SignatureDataset(folder / "boxes", config, folder / "cache")
    signature = dataset[0].signature
    assert np.isclose(signature.volume, 3.6)
    assert np.isclose(signature.area, 2 * (1.2 + 3 + 3.6))
    assert np.all(np.diff(signature.eigenvalues) >= 0)
    # The first mode of a long box is that along its length; of a segment of 3 and two caps it lies near (π / 4)²
    assert 0.3 < signature.eigenvalues[0] < 1.1
    histograms = igps.describe(dataset, igps.descriptor("interior"))
    assert np.allclose(histograms.flatten(1).sum(1), 1, atol=1e-4)
    igps.descriptor("pretrained")  # its parameters are in the package
    sys.argv = ["igps", "retrieve", str(folder / "boxes"), "--cache_dir", str(folder / "cache"), "--n_workers", "1"]
    main()
    distances = igps.chi_square(histograms, histograms)
    assert igps.retrieval_scores(distances, dataset.labels).mean()["nn"] == 1
print("works")
