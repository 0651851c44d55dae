"""Cost of a signature by vertices and eigenpairs, for `igps doctor`: `python -m docs.benchmarks.cost`.

The script measures processor time and peak memory of the signatures of generated bodies, each in a separate process on
one thread. It fits the constants of `igps.analysis.doctor`, and prints them in the form of that module, with their
errors: for the bodies of the fit, and for each body in turn by a fit to the others. Run it again after changes of the
eigensolver or the coordinates. Measurements are stored in --table, and not repeated.
"""

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
from scipy.optimize import nnls

from igps.analysis.doctor import expected_cost
from igps.mesh.loading import load_mesh
from igps.shapes import ArticulatedShapes
from igps.shapes.benchmark import off_text
from igps.signature.signature import SignatureConfig, compute_signature

SIZES = (1_000, 2_500, 6_000, 15_000, 40_000, 100_000)
EIGENPAIRS = (50, 250)
# Classes of generated shapes, one body of each per size; of large bodies only the first few classes.
CLASSES = (0, 1, 3, 5, 6, 7)
N_CLASSES = {40_000: 4, 100_000: 3}
TOLERANCE = 1.5  # factor between expected and measured cost


def measure(path, n_eigenpairs):
    """Measure seconds of processor time for one signature, and the peak memory of this process."""
    mesh = load_mesh(path, least_vertices=n_eigenpairs + 2)
    start = time.process_time()
    compute_signature(mesh, SignatureConfig(n_eigenpairs=n_eigenpairs))
    seconds = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {
        "vertices": len(mesh.vertices),
        "eigenpairs": n_eigenpairs,
        "seconds": seconds,
        "bytes": peak,
    }


def terms(vertices, eigenpairs):
    """The terms of the cost: a constant, vertices, and vertices times eigenpairs."""
    return np.stack([np.ones_like(vertices), vertices, vertices * eigenpairs], axis=1)


def fitted(columns, values):
    """Fit non-negative constants by least squares of relative errors.

    The errors are relative to the geometric mean of a value and its fit in the previous pass, so that values that are
    too high and too low by the same factor count alike.
    """
    weights = 1 / values
    for _ in range(20):
        constants, _ = nnls(columns * weights[:, None], values * weights)
        weights = 1 / np.sqrt(values * np.maximum(columns @ constants, 1e-12))
    return np.asarray(constants)


def accuracy(expected, measured):
    ratio = expected / measured
    factor = np.exp(np.abs(np.log(ratio)))
    return (
        f"{100 * (factor <= TOLERANCE).mean():.0f} % within a factor of {TOLERANCE}, 90 % within "
        f"{np.quantile(factor, 0.9):.2f}; expected over measured {ratio.min():.2f} to {ratio.max():.2f}"
    )


def report(rows):
    vertices, eigenpairs, bodies = (
        np.array([row[key] for row in rows]) for key in ("vertices", "eigenpairs", "body")
    )
    columns = terms(vertices, eigenpairs)
    for key, name in (("seconds", "_SECONDS"), ("bytes", "_BYTES")):
        values = np.array([row[key] for row in rows])
        constants = fitted(columns, values)
        print(
            f"{name}, {name}_PER_VERTEX, {name}_PER_ENTRY = {', '.join(f'{x:.3g}' for x in constants)}"
        )
        print(f"  bodies of the fit: {accuracy(columns @ constants, values)}")
        expected = np.empty(len(values))
        for body in np.unique(bodies):
            own = bodies == body
            expected[own] = columns[own] @ fitted(columns[~own], values[~own])
        print(f"  bodies left out: {accuracy(expected, values)}")
        current = np.array(
            [expected_cost(int(v), int(k)) for v, k in zip(vertices, eigenpairs, strict=True)]
        )
        print(
            f"  current constants: {accuracy(current[:, int(key == 'bytes')], values)}", flush=True
        )


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--table", type=Path, default=Path("build/cost.csv"), help="file of the measurements"
    )
    parser.add_argument(
        "--largest", type=int, default=max(SIZES), help="number of vertices of the largest bodies"
    )
    parser.add_argument("--here", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        print(json.dumps(measure(Path(options.here[0]), int(options.here[1]))))
        return
    rows = []
    if options.table.is_file():
        with options.table.open(newline="") as file:
            rows = [
                {key: float(value) for key, value in row.items()} for row in csv.DictReader(file)
            ]
    done = {(row["size"], row["body"], row["eigenpairs"]) for row in rows}
    options.table.parent.mkdir(parents=True, exist_ok=True)
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    bodies = [
        (size, body)
        for size in SIZES
        if size <= options.largest
        for body in CLASSES[: N_CLASSES.get(size)]
    ]
    for size, body in bodies:
        missing = [
            n_eigenpairs for n_eigenpairs in EIGENPAIRS if (size, body, n_eigenpairs) not in done
        ]
        if not missing:
            continue
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "body.off"
            shape = ArticulatedShapes(body + 1, 1, seed=5, n_vertices=size)[body]
            path.write_text(off_text(shape.vertices, shape.faces))
            for n_eigenpairs in missing:
                command = [sys.executable, __file__, "--here", str(path), str(n_eigenpairs)]
                output = subprocess.run(
                    command, check=True, capture_output=True, text=True, env=os.environ | threads
                )
                rows.append(
                    {"size": size, "body": body, **json.loads(output.stdout.splitlines()[-1])}
                )
        with options.table.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
    report(rows)


if __name__ == "__main__":
    main()
