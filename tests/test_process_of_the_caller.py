"""The library changes nothing in the process that uses it."""

import subprocess
import sys

CODE = """
import gc
import logging
import os
import signal

import matplotlib.pyplot
import pytorch_lightning
import skimage
import sklearn
import torch
import torchmetrics
import trimesh
from torch.utils.data._utils.collate import default_collate_fn_map

def state():
    loggers = [logging.getLogger(), *map(logging.getLogger, list(logging.root.manager.loggerDict))]
    return {
        "handlers": {one.name: one.handlers[:] for one in loggers if one.handlers},
        "collation": dict(default_collate_fn_map),
        "safe classes": torch.serialization.get_safe_globals(),
        "garbage collection": gc.isenabled(), "thresholds": gc.get_threshold(),
        "threads": torch.get_num_threads(),
        "precision": torch.get_float32_matmul_precision(),
        "signals": [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)],
        "environment": dict(os.environ),
    }

torch.set_num_threads(2)
before = state()
switch_off, switched = gc.disable, []
gc.disable = lambda: switched.append(1)
import igps
from igps._compiled import compiled
ball = trimesh.creation.icosphere(subdivisions=2)
config = igps.SignatureConfig(n_eigenpairs=20)
batch = igps.collate([igps.compute_signature(ball, config)])
igps.PairHistogram()(batch)
assert compiled()(lambda x: x + 1)(1) == 2  # a new function, which is compiled now
gc.disable = switch_off
assert not switched, "garbage collection was switched off"
after = state()
changed = [name for name in before if before[name] != after[name]]
assert not changed, [(name, before[name], after[name]) for name in changed]
"""


def test_a_description_leaves_the_process_as_it_was(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(CODE)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
