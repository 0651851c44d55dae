"""Mutation testing: faults are put into the code, one at a time, and the tests should detect them.

Cosmic Ray's operators (comparisons, arithmetic, numbers, loops, returns ...) make the faults, in copies of the tree.
First, the tests of a room run on the unchanged code, to record which functions each test calls and how long it takes.
For each fault, the tests that call its function run, the shortest first, until one fails; then the other tests of the
module. Each run is a fork of a process that has imported PyTorch and other libraries, but nothing of igps.
`python tests/campaign/mutants.py --number 20` lists the surviving mutants with their changes.
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

# This module does not import igps: each test process is a fork of this one, and imports the copy with the fault.
HERE = Path(__file__).parent.resolve()
ROOT = HERE.parents[1]
ROOMS = ("mesh", "signature", "nn", "retrieval")
SEED = 13
# Smallest share of faults that tests should detect
TARGET = 0.9
# A fault may make tests hang. The limit of processor time is _EXTRA_SECONDS plus _FACTOR times their time on the
# unchanged code; it does not depend on the load of the machine. Tests that wait without computing end after an hour.
_EXTRA_SECONDS, _FACTOR = 60, 3
_HOUR = 3600
# Modules that take seconds to import, and start no threads, which a fork would lose
_PRELOADED = (
    *(
        "torch",
        "torch._dynamo",
        "torch.nn.functional",
        "torchmetrics",
        "pytorch_lightning",
        "jsonargparse",
    ),
    *(
        "scipy.sparse.linalg",
        "scipy.spatial",
        "scipy.ndimage",
        "scipy.stats",
        "scipy.optimize",
        "sklearn.decomposition",
    ),
    *(
        "trimesh",
        "networkx",
        "igl",
        "skimage.measure",
        "sklearn.decomposition",
        "numba",
        "hypothesis",
        "pytest",
    ),
)
# Equivalent mutants, which were read one by one: the module, and the line with the fault.
EQUIVALENT: frozenset[tuple[str, str]] = frozenset(
    {
        # `is` in place of `==` is the same for two booleans.
        ("src/igps/retrieval/metric.py", "if self.labels and (ids is None) is bool(self.ids):"),
        # Exact principal components in place of approximate ones, which are only faster.
        (
            "src/igps/retrieval/vectors.py",
            'solver = "randomized" if not n_components < min(features.shape) else "full"',
        ),
        # An empirical constant that is off by one: numbers of directions, bytes of a line for an estimate of sizes.
        ("src/igps/mesh/_union.py", "_N_DIRECTIONS, _SAMPLES_PER_PATCH = 99, 30"),
        ("src/igps/mesh/limits.py", "_OBJ_BYTES, _TEXT_STL_BYTES = 34, 200"),
        (
            "src/igps/nn/heads/closed_form.py",
            "n_directions: int = 59,",
        ),
        # The order of the points affects only the time.
        (
            "src/igps/nn/_kernels/count_by_loops.py",
            "key = key * layout.n_classes - torch.where(share > 0, classes, 0)",
        ),
        # No resolution is above the finest: larger arguments are refused before, and increments are clipped.
        ("src/igps/signature/voxels.py", "if min_samples == 0 or resolution == max_resolution:"),
        # No code compares two instances.
        ("src/igps/signature/sampling.py", "@dataclass(frozen=True, eq=True)"),
        # NumPy accepts any negative number for an unknown length.
        (
            "src/igps/mesh/simplification.py",
            "order = (np.arange(3) + np.reshape(turn, (- 2, 1))) % 3",
        ),
        # The rotation of one ring of a patch relative to the next.
        (
            "src/igps/mesh/_tidying.py",
            "disc.append(_circle((np.arange(size) + ring / 3) / size, radius))",
        ),
        # Values below zero are rounding errors.
        (
            "src/igps/retrieval/graph_reranking.py",
            "return (1 - factor[:, None] * sums[:, 1:] * factor[neighbours]).clip( -1)",
        ),
        (
            "src/igps/retrieval/graph_reranking.py",
            "return np.subtract(1, common, out=common).clip( -1, out=common)",
        ),
    }
)


@dataclass(frozen=True)
class Mutant:
    """A fault in the code.

    Args:
        path: of the module, relative to the root of the tree.
        operator: name of an operator of Cosmic Ray.
        occurrence: index of the position among those where the operator applies.
    """

    path: Path
    operator: str
    occurrence: int


@dataclass(frozen=True)
class Calls:
    """Calls and times of the tests of a room on the unchanged code.

    Args:
        tests: by name, seconds and the called functions as "module.py:line".
        shared: functions that fixtures of several tests call.
    """

    tests: dict[str, tuple[float, frozenset[str]]]
    shared: frozenset[str]

    def of(self, mutant: Mutant) -> list[list[str]]:
        """Groups of tests to run in order: those that call the function, then those of the module's test file."""
        function = _function(mutant)
        callers = {name for name, (_, functions) in self.tests.items() if function in functions}
        own = {
            name
            for name in self.tests
            if Path(name.partition("::")[0]).stem == f"test_{mutant.path.stem}"
        }
        if (
            function in self.shared or not callers
        ):  # such as code that runs on import, or is compiled
            callers, own = own, set(self.tests)
        first = sorted(callers, key=lambda name: self.tests[name][0])
        others = sorted(own - callers, key=lambda name: self.tests[name][0])
        return [group for group in (first, others) if group]

    def seconds(self, names: Sequence[str]) -> float:
        """Total time of some tests."""
        return sum(self.tests[name][0] for name in names)


def _function(mutant: Mutant) -> str:
    """The innermost function around the fault, as "module.py:line" of its first line; line 0 if there is none."""
    line, *_ = difference(mutant)
    first = 0
    for node in ast.walk(ast.parse((ROOT / mutant.path).read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and line <= (
            node.end_lineno or 0
        ):
            start = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
            # Decorators and defaults are evaluated when the module is imported.
            if start <= line and line >= node.body[0].lineno:
                first = max(first, start)
    return f"{mutant.path}:{first}"


def sample(number: int, rooms: Sequence[str] = ROOMS) -> list[Mutant]:
    """Draw `number` faults of each room uniformly at random. A smaller sample is the beginning of a larger one."""
    chosen: list[Mutant] = []
    for room in rooms:
        candidates = [mutant for path in _modules(room) for mutant in _mutants(path)]
        order = np.random.default_rng(SEED).permutation(len(candidates))
        faults = (candidates[i] for i in order if _is_fault(candidates[i]))
        chosen += [mutant for _, mutant in zip(range(number), faults, strict=False)]
    return chosen


def _modules(room: str) -> list[Path]:
    paths = sorted((ROOT / "src" / "igps" / room).rglob("*.py"))
    return [path.relative_to(ROOT) for path in paths if path.name != "__init__.py"]


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
    """The source of the module with the fault."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    code = mutate_code(
        (ROOT / mutant.path).read_text(), get_operator(mutant.operator)(), mutant.occurrence
    )
    return str(code)


def _is_fault(mutant: Mutant) -> bool:
    """Whether a mutant is valid Python and changes a computation, not only an annotation or a message."""
    try:
        return _executable(mutated(mutant)) != _executable((ROOT / mutant.path).read_text())
    except SyntaxError:
        return False


def _executable(source: str) -> str:
    """The syntax tree of a module without annotations, messages and kinds of arguments."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            node.returns = None
        elif isinstance(node, ast.arg):
            node.annotation = None
        elif isinstance(
            node, ast.arguments
        ):  # positional-only and keyword-only markers do not change a computation
            node.args = [*node.posonlyargs, *node.args, *node.kwonlyargs]
            node.defaults = [
                *node.defaults,
                *(default for default in node.kw_defaults if default is not None),
            ]
            node.posonlyargs, node.kwonlyargs, node.kw_defaults = [], [], []
        elif isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(None)
        elif isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            node.exc.args = []
        elif isinstance(node, ast.Call) and ast.unparse(node.func).startswith(
            ("logger.", "warnings.warn")
        ):
            node.args = []
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "TYPE_CHECKING":
            node.value = ast.Constant(None)
    return ast.dump(tree)


@functools.cache
def difference(mutant: Mutant) -> tuple[int, str, str]:
    """Line number, the original line, and the line with the fault."""
    before, after = (ROOT / mutant.path).read_text().splitlines(), mutated(mutant).splitlines()
    for kind, first, last, start, end in difflib.SequenceMatcher(
        a=before, b=after, autojunk=False
    ).get_opcodes():
        if kind != "equal":
            return (
                first + 1,
                " ".join(before[first:last]).strip(),
                " ".join(after[start:end]).strip(),
            )
    return 0, "", ""


def is_noticed(mutant: Mutant, plan: Sequence[tuple[list[str], float]]) -> bool:
    """Whether a test fails or hangs with the fault in this process's copy of the tree.

    Args:
        mutant: the fault.
        plan: groups of tests to run in order, and the seconds that each takes on the unchanged code.
    """
    module = _copy_of_process() / mutant.path
    content, stamp = module.read_bytes(), module.stat()
    module.write_text(mutated(mutant))
    try:
        return any(_run(group, seconds) not in (0, 5) for group, seconds in plan)
    finally:
        module.write_bytes(content)
        # With the original time, Python uses its compiled file again.
        os.utime(module, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))


def called(room: str) -> tuple[Calls, list[str]]:
    """Run the tests of a room on the unchanged code. Returns their calls, and the names of tests that fail."""
    report = _copy_of_process().with_name(f"{room}.json")
    status = _run([f"tests/{room}"], _HOUR, ("-p", "called"), report)
    if status not in (0, 1):
        log = report.with_suffix(".log").read_text()[-1000:]
        raise RuntimeError(
            f"tests/{room}: pytest ends with {status} on the unchanged code; its log ends with {log}"
        )
    results = json.loads(report.read_text())
    tests = {
        name: (test["seconds"], frozenset(test["functions"]))
        for name, test in results["tests"].items()
    }
    return Calls(tests, frozenset(results["shared"])), results["failed"]


def _run(
    tests: Sequence[str],
    seconds: float,
    plugins: Sequence[str] = ("-x",),
    report: Path | None = None,
) -> int | None:
    """Run tests in the given order on this process's copy of the tree, and return pytest's exit status.

    If the tests take too long, the status is None, or minus the signal that ended them.
    """
    deadline = time.monotonic() + _HOUR + seconds
    pid = os.fork()
    if pid == 0:
        _become_pytest([*plugins, *tests], int(_EXTRA_SECONDS + _FACTOR * seconds), report)
    try:
        while time.monotonic() < deadline:
            has_ended, status = os.waitpid(pid, os.WNOHANG)
            if has_ended:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.02)
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        return None
    finally:
        with contextlib.suppress(ProcessLookupError):  # kill processes that outlive their tests
            os.killpg(pid, signal.SIGKILL)


def _become_pytest(arguments: Sequence[str], limit: int, report: Path | None) -> None:
    status = 70
    try:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
        copy = _copy_of_process()
        os.chdir(copy)
        log = os.open(
            report.with_suffix(".log") if report else os.devnull,
            os.O_WRONLY | os.O_CREAT | os.O_TRUNC,
        )
        for stream in (1, 2):
            os.dup2(log, stream)
        # The copy comes first on the path, so that the tests and their processes import it.
        sys.path[:] = dict.fromkeys(
            [str(copy), str(copy / "src"), str(HERE), *filter(None, sys.path)]
        )
        os.environ["PYTHONPATH"] = os.pathsep.join(sys.path[1:])
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
        os.environ["IGPS_CAMPAIGN_CALLED"] = str(report)
        sys.dont_write_bytecode = True
        importlib.invalidate_caches()
        # Workers import the main module. Without this line, it would be a module of the campaign.
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


_copies: list[Path] = []


def _take_copy(copies: Any) -> None:
    """Assign one of the copies of the tree to this process."""
    _copies[:] = [copies.get()]


def _copy_of_process() -> Path:
    return _copies[0]


def _preload() -> None:
    """Import slow modules for all forks of this process."""
    if imported := [name for name in sys.modules if name.partition(".")[0] == "igps"]:
        raise RuntimeError(
            f"{imported[0]} is imported already: tests in forked processes would see no fault"
        )
    os.environ["OMP_NUM_THREADS"] = "1"
    for name in _PRELOADED:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)


def campaign(number: int, rooms: Sequence[str] = ROOMS) -> list[Row]:
    """Try `number` faults of each room, one per core at a time."""
    _preload()
    n_processes = len(os.sched_getaffinity(0))
    context = multiprocessing.get_context("fork")
    with tempfile.TemporaryDirectory(prefix="igps-campaign-") as folder:
        copies = context.SimpleQueue()
        first = _copy_tree(Path(folder) / "0")
        compileall.compile_dir(first / "src", quiet=2)
        for i in range(n_processes):
            copies.put(first if i == 0 else shutil.copytree(first, Path(folder) / str(i)))
        with ProcessPoolExecutor(n_processes, context, _take_copy, (copies,)) as pool:
            # A test that fails on the unchanged code would detect every fault.
            unchanged = dict(zip(rooms, pool.map(called, rooms), strict=True))
            # All rooms are submitted at once, so that no core waits for the last fault of a room.
            tried = {room: _submit(room, number, unchanged[room][0], pool) for room in rooms}
            return [_row(room, *unchanged[room], tried[room]) for room in rooms]


def _copy_tree(folder: Path) -> Path:
    for name in ("src", "tests", "training", "configs"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "Makefile"):
        shutil.copy2(ROOT / name, folder / name)
    return folder


def _attempt(mutant: Mutant, plan: Sequence[tuple[list[str], float]]) -> bool:
    start = time.monotonic()
    noticed = is_noticed(mutant, plan)
    line, before, after = difference(mutant)
    verdict = "noticed " if noticed else "SURVIVES"
    print(
        f"{verdict} {time.monotonic() - start:4.0f} s {mutant.path}:{line}  {before}  ->  {after}",
        flush=True,
    )
    return noticed


def _submit(
    room: str, number: int, calls: Calls, pool: Executor
) -> dict[Mutant, Future[bool] | None]:
    """Submit the faults of a room. The results of equivalent mutants, which are not tried, are None."""
    futures: dict[Mutant, Future[bool] | None] = {}
    for mutant in sample(number, [room]) if calls.tests else []:
        plan = [(group, calls.seconds(group)) for group in calls.of(mutant)]
        is_equivalent = (str(mutant.path), difference(mutant)[2]) in EQUIVALENT
        futures[mutant] = None if is_equivalent else pool.submit(_attempt, mutant, plan)
    return futures


def _row(
    room: str, calls: Calls, failed: list[str], tried: dict[Mutant, Future[bool] | None]
) -> Row:
    start = time.monotonic()
    missed = [f"{name} fails on the unchanged code" for name in failed]
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
    """Try faults, and list the surviving mutants."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--number", type=int, default=20, help="number of faults in each room")
    parser.add_argument("--rooms", nargs="+", default=ROOMS, help="folders of src/igps")
    arguments = parser.parse_args()
    rows = campaign(arguments.number, arguments.rooms)
    print(table(rows))
    sys.exit(not all(row.met for row in rows))


if __name__ == "__main__":
    main()
