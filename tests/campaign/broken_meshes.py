"""Broken mesh files are refused in a sentence that names them, or every number made of them is confirmed.

`python tests/campaign/broken_meshes.py --case 123` repeats one file and keeps it.
"""

from __future__ import annotations

import argparse
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from mutator import Broken, broken_mesh
from outcome import Row
from reference import confirm

from igps import LoadOptions, MeshError, SignatureConfig, compute_signature, load_mesh
from igps._parallel import Failed, Limits, run
from igps.mesh import mending
from igps.mesh.options import Component
from igps.mesh.simplification import simplify
from igps.mesh.watertight import watertight
from igps.spectra._lanczos import ConvergenceError

SEED = 13
CONFIG = SignatureConfig(n_eigenpairs=6, resolution=9, min_samples=0, n_surface_samples=40)
MANY_VERTICES = 1000
# The surfaces are small, and a coarse grid shows as much of them as the ordinary one of 96 cells, in a tenth of the
# time. One file in so many is mended on the ordinary one nevertheless.
COARSE, ORDINARY_EACH = 32, 10
# A case takes a tenth of a second, the first one of a process some seconds. What takes longer than this hangs, on a
# machine that has ten times as much to do beside as well.
SECONDS = 300.0
MEMORY = 4 * 2**30
_MISSING = "needs a module that is not installed"


@dataclass(frozen=True)
class Verdict:
    """What became of a file.

    Args:
        kind: "refused", "confirmed" or "wrong".
        reason: what was said of a refused one; what is wrong.
        checks: how often each number was confirmed, by name.
    """

    kind: str
    reason: str = ""
    checks: tuple[str, ...] = ()


def examine(job: tuple[int, int]) -> Verdict:
    """Read and describe the file of a number, in a folder that is removed."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="igps-campaign-") as folder:
        return judge(broken_mesh(*job), Path(folder), number=job[1])


def judge(broken: Broken, folder: Path, number: int) -> Verdict:
    """What becomes of a file, read as half of the users would."""
    path = folder / broken.name
    path.write_bytes(broken.content)
    reading, changed = _reading(number)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of overflow in readers, among others; the numbers are checked
        try:
            with _grid(number):
                mesh = load_mesh(path, reading)
            if len(mesh.vertices) > MANY_VERTICES:  # mending may make many
                mesh = simplify(mesh, MANY_VERTICES)
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
        # Where nothing may be changed, what is read is what was written.
        wanted = None if changed else broken.arrays
        try:
            with np.errstate(all="ignore"):
                doubts, checks = confirm(mesh, signature, wanted, CONFIG, path.suffix)
        except MeshError as error:
            return Verdict("wrong", f"the moved mesh is refused: {error}")
    return Verdict("wrong", "; ".join(doubts), tuple(checks)) if doubts else Verdict("confirmed", "", tuple(checks))


def _reading(number: int) -> tuple[LoadOptions, bool]:
    """How the file of this number is read, and whether that may change the surface."""
    component: Component | None = "largest" if number % 7 == 1 else None
    allow_open = number % 3 == 1
    mend = ("never", "auto", "never", "auto", "never", "auto", "never", "always")[number % 8]
    return LoadOptions(mend=mend, component=component, allow_open=allow_open), mend != "never" or bool(component)  # type: ignore[arg-type]


def _grid(number: int) -> AbstractContextManager[object]:
    """While it lasts, what is made watertight is so on the grid of this file's number."""
    if number % ORDINARY_EACH == 0:
        return nullcontext()
    return patch.object(mending, "watertight", partial(watertight, resolution=COARSE))


def campaign(n_cases: int, n_workers: int | None = None) -> list[Row]:
    """Read and describe so many files."""
    return tallied(
        "broken meshes",
        "OFF, OBJ, PLY, STL, GLB and 3MF read and described",
        "no traceback, hang or crash, every number confirmed",
        examine,
        [(SEED, number) for number in range(n_cases)],
        lambda number: broken_mesh(SEED, number).story,
        n_workers,
    )


def tallied(
    part: str,
    what: str,
    target: str,
    examined: Callable[[tuple[int, int]], Verdict],
    jobs: Sequence[tuple[int, int]],
    story: Callable[[int], str],
    n_workers: int | None,
) -> list[Row]:
    """The row of a part, from what becomes of each file by its seed and number; a story tells what was broken."""
    start = time.monotonic()
    kinds: Counter[str] = Counter()
    reasons: Counter[str] = Counter()
    checks: Counter[str] = Counter()
    missed = []
    for place, verdict in run(examined, jobs, n_workers=n_workers, limits=Limits(SECONDS, MEMORY)):
        number = jobs[place][1]
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
            details={"kinds": dict(kinds), "confirmations": dict(checks), "refusals": dict(reasons.most_common(40))},
            seconds=time.monotonic() - start,
        )
    ]


def main() -> None:
    """Repeat one case and say what became of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--case", type=int, required=True, help="number of the file")
    parser.add_argument("--out", type=Path, default=Path("build/campaign"), help="folder that keeps the file")
    arguments = parser.parse_args()
    broken = broken_mesh(SEED, arguments.case)
    arguments.out.mkdir(parents=True, exist_ok=True)
    print(arguments.out / broken.name, broken.story, sep="\n")
    print(judge(broken, arguments.out, arguments.case))


if __name__ == "__main__":
    main()
