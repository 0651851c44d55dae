"""What a training step costs, by whichever igps is on the path: of now, or of version 0.2.0.

    python steps.py FOLDER-OF-MESHES

For each line of its input it tells the seconds of a step of `rich` with learnable bins and filters: 40 shapes of 4
classes with 400 samples each, the distances of all to all, a contrastive loss, its gradients, and the update.
"""

from __future__ import annotations

import hashlib
import importlib
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import igps

N_SHAPES, N_CLASSES, N_SAMPLES = 40, 4, 400


def main() -> None:
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    root = Path(sys.argv[1])
    version = hashlib.sha256(igps.__file__.encode()).hexdigest()[:8]
    rich = importlib.import_module("igps.descriptors.rich").rich
    descriptor: Any = rich(learnable=True, n_training_samples=N_SAMPLES).train()
    config = igps.SignatureConfig(
        n_eigenpairs=50, attributes=("depth", "electrostatic_potential", "surface_direction"), n_surface_samples=2000
    )
    dataset: Any = igps.SignatureDataset(root, config, root.parent / f"cache-{version}")
    batch = importlib.import_module("igps").collate([dataset[i % len(dataset)] for i in range(N_SHAPES)])
    same = torch.arange(N_SHAPES) % N_CLASSES
    optimizer = torch.optim.Adam(descriptor.parameters())
    step(descriptor, optimizer, batch, same)  # with all that is loaded and compiled the first time
    for _ in sys.stdin:
        start = time.process_time()
        step(descriptor, optimizer, batch, same)
        print(time.process_time() - start, flush=True)


def step(descriptor: Any, optimizer: torch.optim.Optimizer, batch: Any, classes: Tensor) -> None:
    described = descriptor(batch).flatten(1)
    likeness = -20 * torch.cdist(described.clamp(min=1e-9).sqrt(), described.clamp(min=1e-9).sqrt())
    likeness = likeness.masked_fill(torch.eye(len(classes), dtype=torch.bool), -torch.inf).log_softmax(dim=1)
    loss = -likeness[(classes[:, None] == classes) & ~torch.eye(len(classes), dtype=torch.bool)].mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


if __name__ == "__main__":
    main()
