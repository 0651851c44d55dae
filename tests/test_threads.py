from __future__ import annotations

import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from numpy.testing import assert_array_equal
from pytorch_lightning import Trainer
from threadpoolctl import threadpool_info
from torch.utils.data import DataLoader

import igps
from commands import error_of
from conftest import set_blas_threads, torch_threads
from igps._parallel import on_threads
from igps._threads import Team, n_cores, n_threads, one_thread
from igps.data.batch import LabelledSignature
from igps.nn.heads.learned import BlendedDistance, ProjectionHead
from igps.signature.signature import SignatureConfig
from own_descriptors import CONFIG

needs_affinity = pytest.mark.skipif(
    not hasattr(os, "sched_setaffinity"), reason="needs an affinity to set"
)


def blas():
    """Threads of NumPy's and SciPy's products."""
    found = [library for library in threadpool_info() if library["user_api"] == "blas"]
    return [library["num_threads"] for library in found]


def in_new_thread(function):
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(function).result()


def settings():
    """Of this thread, of new threads, and of the process."""
    return torch.get_num_threads(), in_new_thread(torch.get_num_threads), blas()


@pytest.fixture(autouse=True)
def three_threads():
    """An unusual number, so that what restores another is seen."""
    set_blas_threads(3)
    with torch_threads(3):
        yield
    set_blas_threads(1)


def seen_cores():
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def test_cores_are_at_most_those_of_the_machine_and_of_the_affinity():
    assert 1 <= n_cores() <= seen_cores()


@pytest.mark.parametrize(
    ("quota", "granted"), [("50000 100000", 1), ("150000 100000", 2), ("max 100000", 64)]
)
def test_cores_are_those_that_the_container_grants(monkeypatch, tmp_path, quota, granted):
    """The quota of control groups of version 2, as a container sees its own."""
    (tmp_path / "cpu.max").write_text(quota + "\n")
    monkeypatch.setattr("igps._threads.CPU_QUOTA", tmp_path / "cpu.max")
    assert n_cores() == min(granted, seen_cores())


@needs_affinity
def test_on_one_core_a_body_is_computed_on_one_thread():
    """A process of its own, as the affinity is that of all threads."""
    program = (
        "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "for name in [name for name in os.environ if name.endswith('_NUM_THREADS')]: del os.environ[name]\n"
        "import igps, torch, trimesh; from igps._threads import n_cores, n_threads\n"
        "ball = trimesh.creation.icosphere(subdivisions=3)\n"
        "config = igps.SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=60)\n"
        "signature = igps.compute_signature(igps.Mesh(ball.vertices, ball.faces), config)\n"
        "print(n_cores(), n_threads(), round(float(signature.eigenvalues[0]), 1))"
    )
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert done.stdout.split() == ["1", "1", "2.0"]


def test_settings_are_one_inside_and_as_before_outside(many_cores):
    before = settings()
    assert before[:2] == (3, 3)
    environment = dict(os.environ)
    with one_thread():
        assert torch.get_num_threads() == 1
        assert blas() == [1] * len(before[2])
        with one_thread():
            assert torch.get_num_threads() == 1
            assert n_threads() == 3
        assert torch.get_num_threads() == 1
        assert blas() == [1] * len(before[2])
    assert settings() == before
    assert os.environ == environment


def test_threads_that_overlap_leave_each_other_as_they_were():
    """Each begins within the one before and ends after it, which is where settings of the process get lost."""
    before = settings()
    entered = [threading.Event() for _ in range(4)]
    found = []

    def one(i):
        torch.set_num_threads(4 + i)
        outside = torch.get_num_threads()
        with one_thread():
            inside = torch.get_num_threads()
            entered[i].set()
            if i + 1 < len(entered):
                assert entered[i + 1].wait(60)
            assert set(blas()) == {1}
        found.append((outside, inside, torch.get_num_threads()))

    def run(i):
        if i:
            assert entered[i - 1].wait(60)
        one(i)

    workers = [threading.Thread(target=run, args=(i,)) for i in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    expected = [
        (4, 1, 4),
        (5, 1, 5),
        (6, 1, 6),
        (7, 1, 7),
    ]
    assert sorted(found) == expected
    assert torch.get_num_threads() == before[0]
    assert blas() == before[2]


FORKING = """
import os, sys, threading, time
import numpy as np, numba, torch
from torch.utils.data import DataLoader
from igps._threads import n_threads, one_thread
from igps.nn._precision import full_precision
from igps.retrieval import euclidean

def inside():
    with one_thread(), full_precision():
        assert torch.get_num_threads() == 1
        euclidean(torch.ones(2, 3), torch.ones(2, 3))  # a compiled loop
    assert torch.get_num_threads() == outside

class Items:
    def __len__(self):
        return 6
    def __getitem__(self, i):
        global outside
        outside = torch.get_num_threads()  # PyTorch gives its workers one
        inside()
        return i

def loop():
    while running:
        with one_thread(), full_precision():
            pass

def compile():
    while running:
        numba.njit(lambda x: x + 1)(1)

torch.set_num_threads(3)
torch.set_float32_matmul_precision("medium")
outside, running = 3, True
inside()
busy = [threading.Thread(target=function, daemon=True) for function in (loop, loop, compile)]
for thread in busy:
    thread.start()
for _ in range(int(sys.argv[1])):
    child = os.fork()
    if child == 0:
        failed = 1
        try:
            inside()
            failed = 0
        finally:
            os._exit(failed)
    deadline = time.monotonic() + 30
    while (ended := os.waitpid(child, os.WNOHANG))[0] == 0:
        if time.monotonic() > deadline:
            os.kill(child, 9)
            sys.exit("a child hangs")
        time.sleep(0.001)
    assert ended[1] == 0
loader = DataLoader(Items(), num_workers=2, multiprocessing_context="fork", timeout=60)
assert sorted(int(i) for i in loader) == [*range(6)]
running = False
for thread in busy:
    thread.join()
assert torch.get_num_threads() == outside
assert torch.get_float32_matmul_precision() == "medium"
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_no_child_hangs_that_is_forked_beside_busy_threads(tmp_path):
    """They hold the locks of settings and of the compiler most of the time. A child has its parent's settings."""
    script = tmp_path / "forking.py"
    script.write_text(FORKING)
    subprocess.run([sys.executable, str(script), "40"], check=True, timeout=240)


def test_no_more_threads_than_there_are_cores():
    assert n_cores() == n_threads() == 1
    with one_thread():
        assert n_threads() == 1


def test_no_more_threads_than_torch_had(many_cores):
    assert n_threads() == 3
    with one_thread():
        assert n_threads() == 3
    torch.set_num_threads(1)
    assert n_threads() == 1


def test_jobs_on_threads_have_one_thread_each_and_start_no_more(many_cores):
    before = settings()

    def job(i):
        return i, torch.get_num_threads(), n_threads(), sum(on_threads(lambda x: x, [i, i]))

    assert list(on_threads(job, range(7))) == [(i, 1, 1, 2 * i) for i in range(7)]
    assert list(on_threads(job, range(2), 1)) == [(i, 1, 3, 2 * i) for i in range(2)]
    assert list(on_threads(job, [])) == []
    assert settings() == before


@pytest.mark.parametrize("n", [1, 3])
def test_jobs_that_fail_or_are_left_undone_leave_no_setting(many_cores, n):
    before = settings()
    with pytest.raises(ZeroDivisionError):
        list(on_threads(lambda i: 1 / i, [1, 0, 2], n))
    assert settings() == before
    results = on_threads(lambda i: i, [1, 2, 3], n)
    assert next(results) == 1
    assert torch.get_num_threads() == 3  # the caller's own work in between is its own
    del results
    assert settings() == before


def test_calls_on_a_body_leave_the_settings(blob):
    before = settings()
    signature = igps.compute_signature(blob, CONFIG)
    igps.descriptor("d2")(igps.collate([signature]))
    with pytest.raises(ValueError, match="expected at least 10002 vertices"):
        igps.compute_signature(blob, SignatureConfig(n_eigenpairs=10_000))
    with ThreadPoolExecutor(3) as pool:
        others = list(
            pool.map(
                lambda _: igps.compute_signature(blob, CONFIG),
                range(3),
            )
        )
    expected = signature.interior.eigenfunctions
    for other in others:
        assert_array_equal(other.interior.eigenfunctions, expected)
    assert settings() == before


def test_a_body_is_computed_on_one_thread(blob, monkeypatch):
    seen = []
    original = igps.spectra.eigenpairs

    def watched(*arguments, **options):
        seen.append((torch.get_num_threads(), set(blas())))
        return original(*arguments, **options)

    monkeypatch.setattr("igps.spectra.eigenpairs", watched)
    igps.compute_signature(blob, CONFIG)
    assert seen == [(1, {1})]


def test_one_thread_gives_the_numbers_of_many(blob):
    many = igps.compute_signature(blob, CONFIG)
    torch.set_num_threads(1)
    one = igps.compute_signature(blob, CONFIG)
    for first, second in ((many.interior, one.interior), (many.surface, one.surface)):
        assert_array_equal(first.eigenfunctions, second.eigenfunctions)
        assert_array_equal(first.points, second.points)


class Watched(torch.nn.Module):
    """A description with a parameter, which notes on how many threads its value and its gradient are computed."""

    def __init__(self):
        super().__init__()
        self.scale = torch.nn.Parameter(torch.ones(()))
        self.seen: list[tuple[str, int]] = []
        self.scale.register_hook(lambda _: self.seen.append(("gradient", torch.get_num_threads())))

    def forward(self, batch):
        self.seen.append(("value", torch.get_num_threads()))
        return self.scale * batch.interior.eigenfunctions.abs().mean(dim=1).softmax(dim=1)


def test_a_training_step_is_computed_on_one_thread(blob):
    before = settings()
    signature = igps.compute_signature(blob, CONFIG)
    items = [LabelledSignature(signature, i // 2, str(i)) for i in range(4)]
    described = Watched()
    learner = igps.RetrievalLearner(described, BlendedDistance(ProjectionHead(width=4, n_hidden=8)))
    options = dict.fromkeys(("logger", "enable_checkpointing", "enable_progress_bar"), False)
    trainer = Trainer(max_epochs=1, accumulate_grad_batches=2, accelerator="cpu", **options)
    with pytest.warns(UserWarning, match="val_dataloader"):
        trainer.fit(learner, DataLoader(items, batch_size=2, collate_fn=igps.collate))
    assert described.seen.count(("gradient", 1)) == 2
    assert set(described.seen) == {("value", 1), ("gradient", 1)}
    assert settings() == before


def test_a_command_leaves_the_settings(capsys):
    before = settings()
    assert "nowhere" in error_of(capsys, "retrieve", "nowhere")
    assert settings() == before


@pytest.mark.parametrize("max_threads", [1, 3])
def test_a_team_does_every_job_once_and_in_order(max_threads):
    done = []

    def square(number):
        done.append(number)
        is_main = threading.current_thread() is threading.main_thread()
        return number**2, 1 if is_main else n_threads()

    with Team(max_threads) as team:
        for size in (0, 1, 3, 40, 2):
            done.clear()
            assert team.each(square, range(size)) == [(number**2, 1) for number in range(size)]
            assert sorted(done) == list(range(size))


def test_what_a_job_of_a_team_raises_is_raised_when_no_job_runs_any_more():
    running = threading.Semaphore(0)

    def fail(number):
        if number == 0:
            raise ValueError("the first")
        threading.Event().wait(0.1)
        running.release()

    with Team(2) as team:
        with pytest.raises(ValueError, match="the first"):
            team.each(fail, range(4))
        ended_jobs = running._value
        threading.Event().wait(0.3)
        assert running._value == ended_jobs
        assert team.each(abs, [-1, -2]) == [1, 2]


@pytest.mark.parametrize("inference", [True, False])
def test_a_team_computes_in_the_mode_of_who_asks(inference):
    together = threading.Barrier(2, timeout=20)

    def add(number):
        together.wait()
        sums[number] += 1
        return torch.is_inference_mode_enabled()

    with torch.inference_mode(inference), Team(2) as team:
        sums = torch.zeros(2)
        assert team.each(add, range(2)) == [inference, inference]
    assert sums.tolist() == [1, 1]
