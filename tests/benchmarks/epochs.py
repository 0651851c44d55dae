"""Cost of an epoch over stored signatures, by the igps on the path: the current version, or version 0.2.0.

    python epochs.py FOLDER-OF-MESHES

Each line of standard input is a number of worker processes, followed by "memory" for signatures in memory. The script
prints the seconds of an epoch in batches of 16 for each, without the start of the workers.
"""

import hashlib
import importlib
import sys
import time
import warnings
from pathlib import Path

import torch
from torch.utils.data import DataLoader

import igps

N_ITEMS = 400


def main():
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    root = Path(sys.argv[1])
    version = hashlib.sha256(igps.__file__.encode()).hexdigest()[:8]
    config = igps.SignatureConfig(n_eigenpairs=64)
    dataset = igps.SignatureDataset(root, config, root.parent / f"cache-{version}")
    dataset.precompute(n_workers=1, progress=False)
    indices = [i % len(dataset) for i in range(N_ITEMS)]
    collate = importlib.import_module("igps").collate
    loaders = {}
    for line in sys.stdin:
        n_workers, *where = line.split()
        if line not in loaders:
            items = dataset.to_memory() if where and hasattr(dataset, "to_memory") else dataset
            n = int(n_workers)
            loaders[line] = DataLoader(
                items,
                16,
                sampler=indices,
                num_workers=n,
                persistent_workers=n > 0,
                collate_fn=collate,
            )
            epoch(loaders[line])
        print(epoch(loaders[line]), flush=True)


def epoch(loader):
    start = time.perf_counter()
    n_seen = sum(len(batch.ids) for batch in loader)
    assert n_seen == N_ITEMS
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
