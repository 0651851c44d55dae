"""What a signature costs by vertices and eigenpairs, for `igps doctor`: `python tests/benchmarks/cost.py`.

Measures the processor time and the peak memory of the signatures of generated bodies, each in a process of its own on
one thread, fits the constants of `igps.analysis.doctor`, prints them as they stand there, and tells how far off they
are, on the bodies they were fitted to and, fitted to the others, on each body that is left out. Run it again when the
eigensolver or the coordinates change; --table keeps what was measured, and what is there is not measured again.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from igps.analysis.doctor import expected_cost
from igps.mesh.loading import load_mesh
from igps.shapes import ArticulatedShapes
from igps.shapes.benchmark import off_text
from igps.signature.signature import SignatureConfig, compute_signature

SIZES = (1_000, 2_500, 6_000, 15_000, 40_000, 100_000)
EIGENPAIRS = (50, 250)
# Bodies of each size: classes of generated shapes, fewer of the largest.
CLASSES = (0, 3, 7, 12, 20, 31)
FEWER = {40_000: 4, 100_000: 3}
WITHIN = 1.5


def measure(path: Path, n_eigenpairs: int) -> dict[str, float]:
    """Seconds of the processor for one signature, and bytes at most of this process, which has done nothing else."""
    mesh = load_mesh(path, least_vertices=n_eigenpairs + 2)
    start = time.process_time()
    compute_signature(mesh, SignatureConfig(n_eigenpairs=n_eigenpairs))
    seconds = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {"vertices": len(mesh.vertices), "eigenpairs": n_eigenpairs, "seconds": seconds, "bytes": peak}


def terms(vertices: NDArray[np.float64], eigenpairs: NDArray[np.float64]) -> NDArray[np.float64]:
    """What the costs are sums of: a constant, vertices, and vertices times eigenpairs."""
    return np.stack([np.ones_like(vertices), vertices, vertices * eigenpairs], axis=1)


def fitted(columns: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Constants that are not negative, of the least squared relative errors.

    Weights are divided by the fit of the pass before, so that what is too high counts as what is too low.
    """
    weights = 1 / values
    for _ in range(20):
        found, _ = nnls(columns * weights[:, None], values * weights)
        weights = 1 / np.sqrt(values * np.maximum(columns @ found, 1e-12))
    return np.asarray(found)


def accuracy(expected: NDArray[np.float64], measured: NDArray[np.float64]) -> str:
    ratio = expected / measured
    off = np.exp(np.abs(np.log(ratio)))
    return (
        f"within {WITHIN}-fold {100 * (off <= WITHIN).mean():.0f} %, within {np.quantile(off, 0.9):.2f}-fold 90 %; "
        f"expected over measured {ratio.min():.2f} to {ratio.max():.2f}"
    )


def report(rows: list[dict[str, float]]) -> None:
    vertices, eigenpairs, bodies = (np.array([row[key] for row in rows]) for key in ("vertices", "eigenpairs", "body"))
    columns = terms(vertices, eigenpairs)
    for key, name in (("seconds", "_SECONDS"), ("bytes", "_BYTES")):
        values = np.array([row[key] for row in rows])
        constants = fitted(columns, values)
        print(f"{name}, {name}_PER_VERTEX, {name}_PER_ENTRY = {', '.join(f'{x:.3g}' for x in constants)}")
        print(f"  fitted: {accuracy(columns @ constants, values)}")
        left_out = np.empty(len(values))
        for body in np.unique(bodies):
            own = bodies == body
            left_out[own] = columns[own] @ fitted(columns[~own], values[~own])
        print(f"  bodies left out: {accuracy(left_out, values)}")
        now = np.array([expected_cost(int(v), int(k)) for v, k in zip(vertices, eigenpairs, strict=True)])
        print(f"  constants as they are: {accuracy(now[:, int(key == 'bytes')], values)}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", type=Path, default=Path("build/cost.csv"), help="what was measured")
    parser.add_argument("--largest", type=int, default=max(SIZES), help="bodies of at most so many vertices")
    parser.add_argument("--here", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        print(json.dumps(measure(Path(options.here[0]), int(options.here[1]))))
        return
    rows: list[dict[str, float]] = []
    if options.table.is_file():
        with options.table.open(newline="") as file:
            rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]
    done = {(row["size"], row["body"], row["eigenpairs"]) for row in rows}
    options.table.parent.mkdir(parents=True, exist_ok=True)
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    bodies = [(size, body) for size in SIZES if size <= options.largest for body in CLASSES[: FEWER.get(size)]]
    for size, body in bodies:
        wanted = [n_eigenpairs for n_eigenpairs in EIGENPAIRS if (size, body, n_eigenpairs) not in done]
        if not wanted:
            continue
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "body.off"
            shape = ArticulatedShapes(body + 1, 1, seed=5, n_vertices=size)[body]
            path.write_text(off_text(shape.vertices, shape.faces))
            for n_eigenpairs in wanted:
                command = [sys.executable, __file__, "--here", str(path), str(n_eigenpairs)]
                output = subprocess.run(command, check=True, capture_output=True, text=True, env=os.environ | threads)
                rows.append({"size": size, "body": body, **json.loads(output.stdout.splitlines()[-1])})
        with options.table.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
    report(rows)


if __name__ == "__main__":
    main()
