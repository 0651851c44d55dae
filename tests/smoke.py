"""What an installed package must do: python tests/smoke.py VERSION FOLDER, from outside of the tree.

The body is a box, of which area, volume and distances are known; nothing but the dependencies is needed.
"""

import importlib.metadata
import itertools
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
import trimesh

import igps
from igps.cli import main

version, there = sys.argv[1:]
assert importlib.metadata.version("interior-gps") == version
assert Path(igps.__file__).is_relative_to(Path(there).resolve()), igps.__file__

with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    for (kind, length), number in itertools.product(
        {"long": 3.0, "short": 1.0}.items(),
        range(2),
    ):
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
    torn = trimesh.load(folder / "boxes" / "long" / "0.off", process=False)
    torn.update_faces(np.arange(len(torn.faces)) >= 12)
    torn.export(folder / "torn.ply")
    mended = igps.load_mesh(folder / "torn.ply")
    assert mended.notes
    assert np.isclose(mended.volume, 3.6, rtol=0.01)
    options = ["--cache_dir", str(folder / "cache"), "--n_workers", "1"]
    boxes = str(folder / "boxes")
    out = folder / "out"
    for words in (
        ["retrieve", boxes, "--out", str(out), "--report"],
        ["query", str(folder / "torn.ply"), "--gallery", boxes, "--top", "1"],
    ):
        sys.argv = ["igps", *words, *options]
        main()
    assert (out / "report.html").stat().st_size > 100_000
    with np.load(out / "distances.npz") as archive:  # by pretrained
        distances = archive["distances"]
        labels = archive["labels"]
    assert igps.retrieval_scores(torch.from_numpy(distances), labels.tolist()).mean()["nn"] == 1
print("works")
