"""Broken mesh files are refused with a message that names the file, or all their numbers are confirmed.

`python tests/campaign/broken_meshes.py --case 123` repeats the trial of one file, and stores the file.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import traceback
import warnings
from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from damage import broken_mesh
from outcome import Row
from reference import confirm

from igps import LoadOptions, MeshError, SignatureConfig, compute_signature, load_mesh
from igps._parallel import run
from igps.failures import Failed, Limits
from igps.mesh import mending
from igps.mesh.simplification import simplify
from igps.mesh.watertight import watertight
from igps.spectra import ConvergenceError

SEED = 13
CONFIG = SignatureConfig(n_eigenpairs=6, resolution=9, min_samples=0, n_surface_samples=40)
MAX_VERTICES = 1000
# On these small surfaces, a coarse grid is as good as the default grid of 96 cells, and takes a tenth of the time. One
# file in DEFAULT_GRID_EVERY is nevertheless mended on the default grid.
COARSE_RESOLUTION, DEFAULT_GRID_EVERY = 32, 10
# Limits of a trial, which takes a tenth of a second, or some seconds for the first one of a process. Even on a machine
# with ten times this load, a longer trial hangs.
MAX_SECONDS = 300.0
MAX_BYTES = 4 * 2**30
_MISSING = "needs a module that is not installed"


@dataclass(frozen=True)
class Verdict:
    """Result of the trial of a file.

    Args:
        kind: "refused", "confirmed" or "wrong".
        reason: the message of a refusal, or what is wrong.
        checks: names of the confirmed numbers.
    """

    kind: str
    reason: str = ""
    checks: tuple[str, ...] = ()


def examine(job):
    """Try the file of a seed and a number, in a temporary folder."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="igps-campaign-") as folder:
        return judge(broken_mesh(*job), Path(folder), number=job[1])


def judge(broken, folder, number):
    """Read and describe a file with the options of its number, and check the result."""
    path = folder / broken.name
    path.write_bytes(broken.content)
    options, may_change = _options(number)
    with warnings.catch_warnings():
        # Such as those of overflow in readers; the numbers are checked below
        warnings.simplefilter("ignore")
        try:
            with _grid(number):
                mesh = load_mesh(path, options)
            if len(mesh.vertices) > MAX_VERTICES:  # mending may add many vertices
                mesh = simplify(mesh, MAX_VERTICES)
            signature = compute_signature(mesh, CONFIG)
        except (MeshError, ValueError) as error:
            if str(path) not in str(error):
                return Verdict("wrong", f"a {type(error).__name__} does not name the file: {error}")
            if _MISSING in str(error):
                return Verdict("wrong", f"this campaign needs every format: {error}")
            return Verdict("refused", str(error).replace(str(path), "FILE"))
        except Exception as error:
            if isinstance(error, ConvergenceError) and str(path) in str(error):
                return Verdict("refused", str(error).replace(str(path), "FILE"))
            where = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{Path(where.filename).name}:{where.lineno}"
            return Verdict("wrong", f"a traceback of {type(error).__name__} from {place}: {error}")
        # If reading may not change the surface, the arrays are those that were written.
        written = None if may_change else broken.arrays
        try:
            with np.errstate(all="ignore"):
                doubts, checks = confirm(mesh, signature, written, CONFIG, path.suffix)
        except MeshError as error:
            return Verdict("wrong", f"the moved mesh is refused: {error}")
    return (
        Verdict("wrong", "; ".join(doubts), tuple(checks))
        if doubts
        else Verdict("confirmed", "", tuple(checks))
    )


def _options(number):
    """Options for reading the file of a number, and whether they may change the surface."""
    mend = ("never", "auto", "never", "auto", "never", "auto", "never", "always")[number % 8]
    allow_open = number % 3 == 1 and mend != "always"
    # Type: ignore[arg-type]
    return LoadOptions(mend=mend, allow_open=allow_open), mend != "never"


def _grid(number):
    """A context in which surfaces are made watertight on the grid of the file of a number."""
    if number % DEFAULT_GRID_EVERY == 0:
        return nullcontext()
    return patch.object(mending, "watertight", partial(watertight, resolution=COARSE_RESOLUTION))


def campaign(n_cases, n_workers=None):
    """Try `n_cases` files."""
    return count_verdicts(
        "broken meshes",
        "OFF, OBJ, PLY, STL, GLB and 3MF read and described",
        "no traceback, hang or crash, every number confirmed",
        examine,
        [(SEED, number) for number in range(n_cases)],
        lambda number: broken_mesh(SEED, number).story,
        n_workers,
    )


def count_verdicts(part, what, target, examine, jobs, story, n_workers):
    """Examine the file of each job, a seed and a number, and make the row. A story tells how a file was broken."""
    start = time.monotonic()
    kinds = Counter()
    reasons = Counter()
    checks = Counter()
    missed = []
    for index, verdict in run(
        examine, jobs, n_workers=n_workers, limits=Limits(MAX_SECONDS, MAX_BYTES)
    ):
        number = jobs[index][1]
        if isinstance(verdict, Failed):
            verdict = Verdict("wrong", verdict.reason)
        kinds[verdict.kind] += 1
        checks.update(verdict.checks)
        if verdict.kind == "refused":
            reasons[" ".join(word for word in verdict.reason.split() if word.isalpha())[:60]] += 1
        if verdict.kind == "wrong":
            missed.append(f"--case {number} ({story(number)}): {verdict.reason}"[:400])
    return [
        Row(
            part,
            what,
            len(jobs),
            target,
            f"{kinds['refused']} refused, {kinds['confirmed']} confirmed, {kinds['wrong']} wrong",
            missed=sorted(missed),
            details={
                "kinds": dict(kinds),
                "confirmations": dict(checks),
                "refusals": dict(reasons.most_common(40)),
            },
            seconds=time.monotonic() - start,
        )
    ]


def main():
    """Repeat one case and print its verdict."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--case", type=int, required=True, help="number of the file")
    parser.add_argument(
        "--out", type=Path, default=Path("build/campaign"), help="folder for the file"
    )
    arguments = parser.parse_args()
    broken = broken_mesh(SEED, arguments.case)
    arguments.out.mkdir(parents=True, exist_ok=True)
    print(arguments.out / broken.name, broken.story, sep="\n")
    print(judge(broken, arguments.out, arguments.case))


if __name__ == "__main__":
    main()
