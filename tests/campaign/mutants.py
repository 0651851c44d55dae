"""Deliberate faults in the code, one at a time, and whether a test notices.

Cosmic Ray's operators (comparisons, arithmetic, numbers, loops, returns ...) make the faults, in copies of the tree.
The tests of a room are run once on the sound code, which tells what each calls and how long it takes. A fault is shown
to the tests that call the function it is in, the shortest first, until one fails; then to the others of the module.
Each run of tests is a fork of a process that has imported PyTorch and the rest already, but nothing of the library.
`python tests/campaign/mutants.py --number 20` lists those that no test noticed, with what was changed.
"""

from __future__ import annotations

import argparse
import ast
import compileall
import contextlib
import difflib
import functools
import importlib
import json
import multiprocessing
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import types
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from outcome import Row, table

# Nothing here imports the library: each process of tests is forked from this one, and imports it with a fault in it.
HERE = Path(__file__).parent.resolve()
ROOT = HERE.parents[1]
ROOMS = ("mesh", "signature", "nn", "retrieval")
SEED = 13
# Of the faults that are tried, so many are to be noticed by a test.
TARGET = 0.9
# A fault may make tests hang: they may take so much longer than on the sound code. This is time of the processor, which
# a busy machine does not change; a test that waits for nothing at all is ended after an hour.
_SECONDS, _TIMES = 60, 3
_HOUR = 3600
# What takes seconds to import, and starts no threads that a fork would lose.
_HEAVY = (
    *("torch", "torch._dynamo", "torch.nn.functional", "torchmetrics", "pytorch_lightning", "jsonargparse"),
    *(
        "scipy.sparse.linalg",
        "scipy.spatial",
        "scipy.ndimage",
        "scipy.stats",
        "scipy.optimize",
        "sklearn.decomposition",
    ),
    *("trimesh", "networkx", "igl", "skimage.measure", "sklearn.decomposition", "numba", "hypothesis", "pytest"),
)
# Faults that are none, after reading them one by one: the module and the line as the fault leaves it.
EQUIVALENT: frozenset[tuple[str, str]] = frozenset(
    {
        # `is` in place of `==`: both sides are truth values.
        ("src/igps/retrieval/metric.py", "if self.labels and (ids is None) is bool(self.ids):"),
        # Exact principal components in place of approximate ones, which are only faster; of all, either is exact.
        (
            "src/igps/retrieval/vectors.py",
            'found = PCA(n_kept, svd_solver="randomized" if not n_kept < min(features.shape) else "full", '
            "random_state=seed)",
        ),
        # A constant that was chosen, one off: directions to look into, bytes of a line that sizes are guessed from.
        ("src/igps/mesh/_union.py", "_DIRECTIONS, _PLACES_PER_PATCH = 99, 30"),
        ("src/igps/mesh/limits.py", "_OBJ_BYTES, _TEXT_STL_BYTES = 34, 200"),
        (
            "src/igps/nn/heads/closed_form.py",
            "n_directions: int = 59,",
        ),
        # Points whose classes are not side by side only cost time.
        ("src/igps/nn/_kernels/count_by_loops.py", "key = key * layout.n_classes - torch.where(share > 0, classes, 0)"),
        # No resolution is larger than the finest: one that is asked for is refused before, one that grows is cut.
        ("src/igps/signature/voxels.py", "if min_samples == 0 or resolution == finest:"),
        # Nothing compares two of them.
        ("src/igps/signature/sampling.py", "@dataclass(frozen=True, eq=True)"),
        # NumPy takes every negative length for the one that is not known.
        ("src/igps/mesh/simplification.py", "order = (np.arange(3) + np.reshape(turn, (- 2, 1))) % 3"),
        # By how much one ring of a patch is turned against the next.
        ("src/igps/mesh/_tidying.py", "disc.append(_circle((np.arange(size) + ring / 3) / size, radius))"),
        # Below zero there is only rounding.
        (
            "src/igps/retrieval/graph_reranking.py",
            "return (1 - length[:, None] * alike[:, 1:] * length[lists]).clip( -1)",
        ),
        ("src/igps/retrieval/graph_reranking.py", "return (1 - smaller / (2 - smaller)).clip( -1)"),
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


@dataclass(frozen=True)
class Calls:
    """What the tests of a room do on the sound code.

    Args:
        tests: seconds, and functions as "module.py:line", by name.
        shared: functions that the fixtures of several tests call.
    """

    tests: dict[str, tuple[float, frozenset[str]]]
    shared: frozenset[str]

    def of(self, mutant: Mutant) -> list[list[str]]:
        """The tests to run, some and then others: those that call the function, and those of the module's own file."""
        function = _function(mutant)
        calling = {name for name, (_, functions) in self.tests.items() if function in functions}
        own = {name for name in self.tests if Path(name.partition("::")[0]).stem == f"test_{mutant.path.stem}"}
        if function in self.shared or not calling:  # or what runs when the module is imported, or is compiled
            calling, own = own, set(self.tests)
        quick = sorted(calling, key=lambda name: self.tests[name][0])
        others = sorted(own - calling, key=lambda name: self.tests[name][0])
        return [some for some in (quick, others) if some]

    def seconds(self, names: Sequence[str]) -> float:
        """That they take together."""
        return sum(self.tests[name][0] for name in names)


def _function(mutant: Mutant) -> str:
    """The innermost function that the fault is in, as "module.py:line" of its first line; line 0 if it is in none."""
    line, *_ = difference(mutant)
    first = 0
    for node in ast.walk(ast.parse((ROOT / mutant.path).read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and line <= (node.end_lineno or 0):
            begins = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            # Decorators and defaults are evaluated when the module is imported.
            if begins <= line and line >= node.body[0].lineno:
                first = max(first, begins)
    return f"{mutant.path}:{first}"


def sample(number: int, rooms: Sequence[str] = ROOMS) -> list[Mutant]:
    """So many faults of each room, drawn evenly from all that there are in it; fewer ones hold of more."""
    chosen: list[Mutant] = []
    for room in rooms:
        everything = [mutant for path in _modules(room) for mutant in _mutants(path)]
        order = np.random.default_rng(SEED).permutation(len(everything))
        faults = (everything[i] for i in order if _is_fault(everything[i]))
        chosen += [mutant for _, mutant in zip(range(number), faults, strict=False)]
    return chosen


def _modules(room: str) -> list[Path]:
    found = sorted((ROOT / "src" / "igps" / room).rglob("*.py"))
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
    """Whether it changes what is computed, not an annotation, a message or a marker alone, and is Python still."""
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
        elif isinstance(node, ast.arguments):  # whether by place or by name is no matter of what is computed
            node.args = [*node.posonlyargs, *node.args, *node.kwonlyargs]
            node.defaults = [*node.defaults, *(default for default in node.kw_defaults if default is not None)]
            node.posonlyargs, node.kwonlyargs, node.kw_defaults = [], [], []
        elif isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(None)
        elif isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            node.exc.args = []
        elif isinstance(node, ast.Call) and ast.unparse(node.func).startswith(("logger.", "warnings.warn")):
            node.args = []
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "TYPE_CHECKING":
            node.value = ast.Constant(None)
    return ast.dump(tree)


@functools.cache
def difference(mutant: Mutant) -> tuple[int, str, str]:
    """Line number, the line as it was, and what became of it."""
    before, after = (ROOT / mutant.path).read_text().splitlines(), mutated(mutant).splitlines()
    for kind, first, last, start, end in difflib.SequenceMatcher(a=before, b=after, autojunk=False).get_opcodes():
        if kind != "equal":
            return first + 1, " ".join(before[first:last]).strip(), " ".join(after[start:end]).strip()
    return 0, "", ""


def is_noticed(mutant: Mutant, plan: Sequence[tuple[list[str], float]]) -> bool:
    """Whether a test fails, or hangs, with the fault in this process's copy of the tree.

    Args:
        mutant: the fault.
        plan: tests to run, some and then others, and the seconds that they take on the sound code.
    """
    target = _place() / mutant.path
    whole, stamp = target.read_bytes(), target.stat()
    target.write_text(mutated(mutant))
    try:
        return any(_run(some, seconds) not in (0, 5) for some, seconds in plan)
    finally:
        target.write_bytes(whole)
        # What Python compiled of it counts again.
        os.utime(target, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))


def called(room: str) -> tuple[Calls, list[str]]:
    """What the tests of a room do, and which of them fail on the sound code."""
    report = _place().with_name(f"{room}.json")
    status = _run([f"tests/{room}"], _HOUR, ("-p", "called"), report)
    if status not in (0, 1):
        said = report.with_suffix(".log").read_text()[-1000:]
        raise RuntimeError(f"tests/{room}: pytest ends with {status} on the sound code; it says {said}")
    found = json.loads(report.read_text())
    tests = {name: (test["seconds"], frozenset(test["functions"])) for name, test in found["tests"].items()}
    return Calls(tests, frozenset(found["shared"])), found["failed"]


def _run(
    tests: Sequence[str], seconds: float, plugins: Sequence[str] = ("-x",), report: Path | None = None
) -> int | None:
    """pytest's exit status on this process's copy of the tree, the tests in the order given.

    None, or minus the signal that ended it, if it took too long.
    """
    deadline = time.monotonic() + _HOUR + seconds
    pid = os.fork()
    if pid == 0:
        _become_pytest([*plugins, *tests], int(_SECONDS + _TIMES * seconds), report)
    try:
        while time.monotonic() < deadline:
            ended, status = os.waitpid(pid, os.WNOHANG)
            if ended:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.02)
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        return None
    finally:
        with contextlib.suppress(ProcessLookupError):  # processes of the tests that outlive them
            os.killpg(pid, signal.SIGKILL)


def _become_pytest(arguments: Sequence[str], limit: int, report: Path | None) -> None:
    status = 70
    try:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
        place = _place()
        os.chdir(place)
        log = os.open(report.with_suffix(".log") if report else os.devnull, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for stream in (1, 2):
            os.dup2(log, stream)
        # The copy comes first on the path, so that it is what the tests and their processes import.
        sys.path[:] = dict.fromkeys([str(place), str(place / "src"), str(HERE), *(one for one in sys.path if one)])
        os.environ["PYTHONPATH"] = os.pathsep.join(sys.path[1:])
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
        os.environ["IGPS_CAMPAIGN_CALLED"] = str(report)
        sys.dont_write_bytecode = True
        importlib.invalidate_caches()
        # Workers import the main module, which is to be none of the campaign's.
        sys.argv, sys.modules["__main__"] = ["pytest"], types.ModuleType("__main__")
        import pytest

        status = int(pytest.main(["-q", "-p", "no:cacheprovider", *arguments]))
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


_places: list[Path] = []


def _settle(places: Any) -> None:
    """A process takes one of the copies of the tree."""
    _places[:] = [places.get()]


def _place() -> Path:
    return _places[0]


def _warm() -> None:
    """Import what takes long, for every process that is forked from this one."""
    if early := [name for name in sys.modules if name.partition(".")[0] == "igps"]:
        raise RuntimeError(f"{early[0]} is imported already: tests in forked processes would see no fault")
    os.environ["OMP_NUM_THREADS"] = "1"
    for name in _HEAVY:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)


def campaign(number: int, rooms: Sequence[str] = ROOMS) -> list[Row]:
    """So many faults of each room, as many at once as there are cores."""
    _warm()
    n_processes = len(os.sched_getaffinity(0))
    context = multiprocessing.get_context("fork")
    with tempfile.TemporaryDirectory(prefix="igps-campaign-") as folder:
        places = context.SimpleQueue()
        first = _copy(Path(folder) / "0")
        compileall.compile_dir(first / "src", quiet=2)
        for i in range(n_processes):
            places.put(first if i == 0 else shutil.copytree(first, Path(folder) / str(i)))
        with ProcessPoolExecutor(n_processes, context, _settle, (places,)) as pool:
            # Of tests that fail on the sound code every fault would be noticed.
            sound = dict(zip(rooms, pool.map(called, rooms), strict=True))
            # All at once: where the last of one room takes long, the other cores go on with the next room.
            tried = {room: _submitted(room, number, sound[room][0], pool) for room in rooms}
            return [_row(room, *sound[room], tried[room]) for room in rooms]


def _copy(place: Path) -> Path:
    for name in ("src", "tests", "training", "configs"):
        shutil.copytree(ROOT / name, place / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "Makefile"):
        shutil.copy2(ROOT / name, place / name)
    return place


def _attempt(mutant: Mutant, plan: Sequence[tuple[list[str], float]]) -> bool:
    begun = time.monotonic()
    noticed = is_noticed(mutant, plan)
    line, before, after = difference(mutant)
    verdict = "noticed " if noticed else "SURVIVES"
    print(f"{verdict} {time.monotonic() - begun:4.0f} s {mutant.path}:{line}  {before}  ->  {after}", flush=True)
    return noticed


def _submitted(room: str, number: int, calls: Calls, pool: Executor) -> dict[Mutant, Future[bool] | None]:
    """The faults of a room; None in place of those that are known to be none, which are not tried."""
    found: dict[Mutant, Future[bool] | None] = {}
    for mutant in sample(number, [room]) if calls.tests else []:
        plan = [(some, calls.seconds(some)) for some in calls.of(mutant)]
        is_none = (str(mutant.path), difference(mutant)[2]) in EQUIVALENT
        found[mutant] = None if is_none else pool.submit(_attempt, mutant, plan)
    return found


def _row(room: str, calls: Calls, failed: list[str], tried: dict[Mutant, Future[bool] | None]) -> Row:
    start = time.monotonic()
    missed = [f"{name} fails on the sound code" for name in failed]
    if not calls.tests:
        missed.append(f"tests/{room}: there are no tests, and so no fault of {room} was tried")
    notes = []
    for mutant, noticed in tried.items():
        if noticed is not None and not noticed.result():
            line, before, after = difference(mutant)
            notes.append(f"{mutant.path}:{line} survives as `{after}`, was `{before}`")
    n_faults = sum(noticed is not None for noticed in tried.values())
    share = 1 - len(notes) / max(n_faults, 1)
    if share < TARGET:
        missed.append(f"{share:.0%} of the faults are noticed, {TARGET:.0%} expected")
    return Row(
        "deliberate faults",
        room,
        len(tried),
        f"{TARGET:.0%} noticed by a test",
        f"{share:.0%} of {n_faults}, {len(tried) - n_faults} others are no faults",
        missed,
        notes,
        seconds=time.monotonic() - start,
    )


def main() -> None:
    """Try some faults and list the survivors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--number", type=int, default=20, help="of faults of each room")
    parser.add_argument("--rooms", nargs="+", default=ROOMS, help="of src/igps")
    arguments = parser.parse_args()
    rows = campaign(arguments.number, arguments.rooms)
    print(table(rows))
    sys.exit(not all(row.met for row in rows))


if __name__ == "__main__":
    main()
