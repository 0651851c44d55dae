"""A real scheduler and worker processes on this machine."""

import os
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from bodies_on_disk import write_body
from commands import run
from igps.cli.precompute_command import dask_executor, of_shard
from igps.data.dataset import SignatureDataset
from igps.data.pipeline import fill_elsewhere
from igps.failures import MachineError
from igps.mesh.loading import BodyRef
from igps.signature.signature import SignatureConfig

distributed = pytest.importorskip("distributed")

SMALL = {"n_eigenpairs": 20, "resolution": 10, "min_samples": 0, "n_surface_samples": 50}
WORDS = [f"--signature.{name}={value}" for name, value in SMALL.items()]
WORDS += ["--descriptors", "own_descriptors:small_interior"]
CONFIG = SignatureConfig(**SMALL)
SOURCE = str(Path(fill_elsewhere.__code__.co_filename).parents[2])


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


class Cluster:
    """A scheduler and two workers, each a process."""

    def __init__(self, folder):
        self.address = f"tcp://127.0.0.1:{free_port()}"
        self._folder = folder
        self._environment = {
            **os.environ,
            "PYTHONPATH": SOURCE,
            "OMP_NUM_THREADS": "1",
            "DASK_DISTRIBUTED__LOGGING__DISTRIBUTED": "error",
        }
        host, port = self.address.removeprefix("tcp://").split(":")
        self.scheduler = self._start("scheduler", "--host", host, "--port", port, "--no-dashboard")
        self.workers = [self.start_worker() for _ in range(2)]

    def start_worker(self):
        options = ["--nthreads", "1", "--no-nanny", "--no-dashboard", "--death-timeout", "300"]
        return self._start("worker", self.address, *options, "--local-directory", str(self._folder))

    def _start(self, *words):
        command = [sys.executable, "-m", "dask", *words]
        return subprocess.Popen(
            command,
            env=self._environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd=self._folder,
        )

    def end(self):
        for process in [*self.workers, self.scheduler]:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    one = Cluster(tmp_path_factory.mktemp("cluster"))
    try:
        with distributed.Client(one.address, timeout=300, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=300)
        yield one
    finally:
        one.end()


@pytest.fixture
def root(tmp_path):
    for i in range(12):
        write_body(tmp_path / "meshes" / f"{i:02}.off", 1.0 + 0.1 * i, 1.5)
    return tmp_path / "meshes"


def stored(cache):
    return {path.name: path.read_bytes() for path in cache.rglob("*.safetensors")}


def test_a_cluster_leaves_the_bytes_of_this_machine(cluster, root, tmp_path):
    (root / "bad.off").write_text("nothing")
    with dask_executor(cluster.address) as executor:
        there = SignatureDataset(root, CONFIG, tmp_path / "there")
        (failure,) = there.precompute(executor, progress=False)
        again = SignatureDataset(root, CONFIG, tmp_path / "there")
        assert again.precompute(executor, progress=False) == [failure]
    assert failure.id == "bad.off"
    here = SignatureDataset(root, CONFIG, tmp_path / "here")
    assert here.precompute(n_workers=1, progress=False) == [failure]
    assert stored(tmp_path / "there") == stored(tmp_path / "here")
    assert len(stored(tmp_path / "here")) == 13  # with the failure


def test_a_worker_that_is_killed_costs_nothing(cluster, root, tmp_path):
    """In the middle of its work: the others do that."""
    dataset = SignatureDataset(root, CONFIG, tmp_path / "there")
    with dask_executor(cluster.address) as executor, ThreadPoolExecutor(1) as beside:
        running = beside.submit(dataset.precompute, executor, progress=False)
        while len(stored(tmp_path / "there")) < 3:
            time.sleep(0.005)
        cluster.workers[0].send_signal(signal.SIGKILL)
        assert len(stored(tmp_path / "there")) < 12
        assert running.result(timeout=300) == []
    cluster.workers.append(cluster.start_worker())
    names = {name.removesuffix(".safetensors") for name in stored(tmp_path / "there")}
    assert names == {dataset.key(i) for i in range(12)}


def test_the_command_and_what_it_says_of_no_scheduler(cluster, root, tmp_path, monkeypatch, capsys):
    words = ["precompute", root, "--cache_dir", tmp_path / "cache", *WORDS]
    run(*words, "--cluster", cluster.address)
    assert capsys.readouterr().out == "12 of 12 signatures are in the cache; 0 failed\n"
    monkeypatch.setattr(sys.modules[dask_executor.__module__], "_SCHEDULER_TIMEOUT", 1)
    nobody = f"tcp://127.0.0.1:{free_port()}"
    with pytest.raises(SystemExit, match="2"):
        run(*words, "--cluster", nobody)
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("igps: ")]
    assert "no Dask scheduler answers at tcp://127.0.0.1" in line
    assert len(stored(tmp_path / "cache")) == 12


def test_shards_have_all_files_once(root, tmp_path, capsys):
    for n in (1, 7, 64, 300):
        numbers = [i for k in range(1, n + 1) for i in of_shard(100, f"{k}/{n}")]
        assert sorted(numbers) == list(range(100))
    for wrong in ("0/4", "5/4", "3", "a/b", "-1/4", "1/4/2"):
        with pytest.raises(ValueError, match="shard: expected a part such as 3/64"):
            of_shard(100, wrong)
    words = ["precompute", root, "--cache_dir", tmp_path / "cache", "--n_workers", 1, *WORDS]
    for k, n_there in ((2, 6), (1, 12)):
        run(*words, "--shard", f"{k}/2")
        told = f"6 of 6 signatures in shard {k}/2 are in the cache; 0 failed\n"
        assert capsys.readouterr().out == told
        assert len(stored(tmp_path / "cache")) == n_there


class Broken(ThreadPoolExecutor):
    """What an executor does whose scheduler is lost."""

    def submit(self, function, /, *arguments, **options):
        future = Future()
        future.cancel()
        future.set_running_or_notify_cancel()
        return future


class Elsewhere(ThreadPoolExecutor):
    """Does nothing that is seen here."""

    def submit(self, function, /, *arguments, **options):
        return super().submit(lambda bodies: [Nowhere() for _ in bodies], *arguments)


class Nowhere:
    key = "00" * 32


@pytest.mark.parametrize(
    ("executor", "words"),
    [(Broken(1), "the executor cancelled a job"), (Elsewhere(1), "signatures do not appear there")],
)
def test_a_cluster_that_fails_is_told(root, tmp_path, monkeypatch, executor, words):
    monkeypatch.setattr("igps.data.filling._MAX_DELAY", 0.2)
    with pytest.raises(MachineError, match=words):
        SignatureDataset(root, CONFIG, tmp_path / "cache").precompute(executor, progress=False)


def test_a_worker_of_another_version_is_refused(root, tmp_path):
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    with pytest.raises(
        MachineError, match=r"has igps .*, signatures \d+, but 9\.9, signatures 9 is required"
    ):
        fill_elsewhere(dataset.pipeline.fill, "9.9, signatures 9", [BodyRef(root / "00.off")])
    assert stored(tmp_path / "cache") == {}
