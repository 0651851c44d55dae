"""Deliberate faults in the code, one at a time, and whether a test notices.

Cosmic Ray's operators (comparisons, arithmetic, numbers, loops, returns ...) make the faults, in a copy of the tree.
`python tests/campaign/mutants.py --number 60` lists those that no test noticed, with what was changed.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from outcome import Row, table

ROOT = Path(__file__).parents[2]
ROOMS = ("geometry", "nn", "retrieval")
SEED = 13
# Of the faults that are tried, so many are to be noticed by a test.
TARGET = 0.9
_SECONDS = 600
# Faults that are none, after reading them one by one: the module and the line as it was.
EQUIVALENT: frozenset[tuple[str, str]] = frozenset(
    {
        # `is` in place of `==`: both sides are truth values.
        ("src/igps/retrieval/metric.py", "if self.labels and (ids is None) == bool(self.ids):"),
    }
)


@dataclass(frozen=True)
class Mutant:
    """A fault.

    Args:
        path: of the module, from the root of the tree.
        operator: of Cosmic Ray.
        occurrence: which place of those where the operator applies.
    """

    path: Path
    operator: str
    occurrence: int


def sample(number: int, rooms: Sequence[str] = ROOMS) -> list[Mutant]:
    """So many faults of the rooms, drawn evenly from all that there are; fewer ones hold of more."""
    everything = [mutant for room in rooms for path in _modules(room) for mutant in _mutants(path)]
    order = np.random.default_rng(SEED).permutation(len(everything))
    chosen: list[Mutant] = []
    for i in order:
        if len(chosen) == number:
            break
        if _is_fault(everything[i]):
            chosen.append(everything[i])
    return chosen


def _modules(room: str) -> list[Path]:
    found = sorted((ROOT / "src" / "igps" / room).glob("*.py"))
    return [path.relative_to(ROOT) for path in found if path.name != "__init__.py"]


def _mutants(path: Path) -> Iterator[Mutant]:
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator, operator_names

    tree = get_ast((ROOT / path).read_text())
    for name in sorted(operator_names()):
        kind = get_operator(name)
        if kind.arguments():
            continue
        operator = kind()
        count = sum(len(list(operator.mutation_positions(node))) for node in ast_nodes(tree))
        for occurrence in range(count):
            yield Mutant(path, name, occurrence)


def mutated(mutant: Mutant) -> str:
    """The source with the fault in it."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    code = mutate_code((ROOT / mutant.path).read_text(), get_operator(mutant.operator)(), mutant.occurrence)
    return str(code)


def _is_fault(mutant: Mutant) -> bool:
    """Whether it changes anything that runs: not an annotation alone, and it is Python still."""
    try:
        return _running(mutated(mutant)) != _running((ROOT / mutant.path).read_text())
    except SyntaxError:
        return False


def _running(source: str) -> str:
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            node.returns = None
        elif isinstance(node, ast.arg):
            node.annotation = None
        elif isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(None)
    return ast.dump(tree)


def difference(mutant: Mutant) -> tuple[int, str, str]:
    """Line number, the line as it was, and what became of it."""
    before, after = (ROOT / mutant.path).read_text().splitlines(), mutated(mutant).splitlines()
    for kind, first, last, start, end in difflib.SequenceMatcher(a=before, b=after, autojunk=False).get_opcodes():
        if kind != "equal":
            return first + 1, " ".join(before[first:last]).strip(), " ".join(after[start:end]).strip()
    return 0, "", ""


def tests_of(path: Path, sound: Sequence[str]) -> list[list[str]]:
    """The test files for a module in the order to run: its own, then the others of its room."""
    own = [one for one in sound if Path(one).stem == f"test_{path.stem}"]
    others = [one for one in sound if one not in own]
    return [some for some in (own, others) if some]


def is_noticed(mutant: Mutant, copy: Path, files: Sequence[str]) -> bool:
    """Whether a test of these files fails, or hangs, with the fault in the copy of the tree."""
    target = copy / mutant.path
    whole = target.read_text()
    target.write_text(mutated(mutant))
    try:
        return any(not passes(some, copy) for some in tests_of(mutant.path, files))
    finally:
        target.write_text(whole)


def passes(files: Sequence[str], copy: Path) -> bool:
    """Whether the tests of these files pass on the copy of the tree."""
    # The copy comes first on the path, so that it is what the tests import.
    path = os.pathsep.join([str(copy / "src"), *(one for one in sys.path if one)])
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *files]
    try:
        run = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, timeout=_SECONDS, check=False, text=True
        )
    except subprocess.TimeoutExpired:
        return False
    return run.returncode in (0, 5)


def campaign(number: int, rooms: Sequence[str] = ROOMS) -> list[Row]:
    """So many faults, tried one after the other."""
    start = time.monotonic()
    missed: list[str] = []
    with tempfile.TemporaryDirectory(prefix="igps-campaign-") as folder:
        copy = Path(folder)
        for name in ("src", "tests"):
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        for name in ("pyproject.toml", "README.md", "Makefile"):
            shutil.copy(ROOT / name, copy / name)
        # Tests that fail on the sound code would notice everything.
        sound: dict[str, list[str]] = {}
        for room in rooms:
            files = [str(one.relative_to(ROOT)) for one in sorted((ROOT / "tests" / room).glob("test_*.py"))]
            sound[room] = files if files and passes(files, copy) else [one for one in files if passes([one], copy)]
            missed += [f"{one} fails on the sound code" for one in files if one not in sound[room]]
            if not files:
                missed.append(f"tests/{room}: there are no tests, and so no fault of {room} was tried")
        usable = [room for room in rooms if sound[room]]
        tried = survivors = known = 0
        notes = []
        for mutant in sample(number, usable):
            tried += 1
            line, before, after = difference(mutant)
            noticed = is_noticed(mutant, copy, sound[mutant.path.parts[2]])
            print(f"{'noticed ' if noticed else 'SURVIVES'} {mutant.path}:{line}  {before}  ->  {after}", flush=True)
            if noticed:
                continue
            if (str(mutant.path), before) in EQUIVALENT:
                known += 1
                continue
            survivors += 1
            notes.append(f"{mutant.path}:{line} survives as `{after}`, was `{before}`")
    share = 1 - survivors / max(tried - known, 1)
    if tried and share < TARGET:
        missed.append(f"{share:.0%} of the faults are noticed, {TARGET:.0%} expected")
    return [
        Row(
            "deliberate faults",
            ", ".join(usable),
            tried,
            f"{TARGET:.0%} noticed by a test",
            f"{share:.0%} of {tried - known}, {known} others are no faults",
            missed,
            notes,
            seconds=time.monotonic() - start,
        )
    ]


def main() -> None:
    """Try some faults and list the survivors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--number", type=int, default=60, help="of faults")
    parser.add_argument("--rooms", nargs="+", default=ROOMS, help="of src/igps")
    arguments = parser.parse_args()
    rows = campaign(arguments.number, arguments.rooms)
    print(table(rows))
    sys.exit(not all(row.met for row in rows))


if __name__ == "__main__":
    main()
