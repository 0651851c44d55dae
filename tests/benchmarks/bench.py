"""Speed and memory as ratios against named baselines of the same run: `make bench [DATA=folder-of-SHREC07-meshes]`.

Each figure is measured in a separate process, so that its peak memory can be told. Without DATA, meshes are generated.
Our function and the baseline are timed in alternation; the medians of the repetitions count. A measurement is disturbed
if its repetitions differ by more than SPREAD of their median, or if other virtual machines took more than STEAL of the
processor time. It is then repeated, at most ATTEMPTS times in all, and the least disturbed one counts. The table shows
the load of the machine.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median

import numpy as np
import torch
import trimesh
from describing import save as save_signature
from scipy import sparse

import igps
from igps._threads import n_cores
from igps.data.transforms import FewerSamples
from igps.mesh.loading import load_mesh
from igps.mesh.mesh import Mesh
from igps.mesh.winding import winding_number
from igps.nn import axes
from igps.nn.axes import InteriorDistance, Potential
from igps.nn.axes.centres import interval_centres
from igps.nn.histograms import joint_histogram, pair_histogram
from igps.retrieval import chi_square, euclidean
from igps.signature.laplacian import laplacian
from igps.signature.mean_value import extend
from igps.signature.voxels import grid_axes, inside_grid, interior_samples
from igps.spectra import eigenpairs

K = 250
SPREAD, STEAL, ATTEMPTS = 0.3, 0.05, 3
PROJECT = Path(__file__).parents[2]
BEFORE = "8140bb3"  # the commit whose time from meshes to tables of results is the baseline
VERSION_0_2_0 = "fa3a05e"


@dataclass(frozen=True)
class Figure:
    """One line of the table. `ratio` is the factor by which our value is better than the baseline or the target."""

    value: float
    unit: str
    baseline: float
    baseline_name: str
    ratio: float
    note: str = ""


spreads = []
"""Range of the repetitions over their median, for all timings in this process."""


def timed(ours, baseline, repeat=3):
    """Median seconds of both functions, over alternating repetitions."""
    return timed_by(lambda: _seconds(ours), lambda: _seconds(baseline), repeat)


def timed_by(ours, baseline, repeat=3):
    """Like `timed`, for functions that return their own seconds."""
    seconds = ([], [])
    for _ in range(repeat):
        for times, function in zip(seconds, (ours, baseline), strict=True):
            times.append(function())
    spreads.extend((max(times) - min(times)) / median(times) for times in seconds)
    return median(seconds[0]), median(seconds[1])


def _seconds(function):
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


class Machine:
    """Load of the machine: its load average, and the processor time that other virtual machines took since the start.

    Values that the system does not provide are NaN.
    """

    def __init__(self):
        self._start = self._ticks()

    def load(self):
        """Mean number of runnable processes over a minute, those of the benchmark included."""
        return os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")

    def steal(self):
        """Share of the processor time that other virtual machines took."""
        total, stolen = self._start
        total_now, stolen_now = self._ticks()
        return (stolen_now - stolen) / (total_now - total) if total_now > total else float("nan")

    @staticmethod
    def _ticks():
        try:
            ticks = [
                int(word) for word in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
            ]
        except OSError:
            return 0.0, 0.0
        return float(sum(ticks[:8])), float(ticks[7])  # user time includes the time of guests


def against(name, ours, baseline, repeat=3, note=""):
    seconds, reference = timed(ours, baseline, repeat)
    return Figure(seconds, "s", reference, name, reference / seconds, note)


def within(limit, seconds, note=""):
    return Figure(seconds, "s", limit, "target", limit / seconds, note)


def model(data, n_vertices, subdivisions=0):
    """A SHREC'07 model or a generated body of about `n_vertices` vertices, after subdivision at edge midpoints."""
    start = n_vertices // 4**subdivisions
    if data is not None:
        sizes = {path: vertex_count(path) for path in sorted(data.glob("*.off"))}
        mesh = load_mesh(min(sizes, key=lambda path: abs(sizes[path] - start)))
    else:
        shape = igps.ArticulatedShapes(n_classes=2, n_per_class=1, n_vertices=start)[1]
        mesh = Mesh(shape.vertices, shape.faces, name=shape.name)
    vertices = np.asarray(mesh.vertices)
    faces = np.asarray(mesh.faces)
    for _ in range(subdivisions):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    return Mesh(vertices, faces, name=mesh.name)


def vertex_count(path):
    with path.open() as file:
        file.readline()
        return int(file.readline().split()[0])


def by_eigsh(stiffness, mass, k=K):
    return sparse.linalg.eigsh(
        stiffness.tocsc(), k + 1, sparse.diags(mass, format="csc"), sigma=-0.01 / mass.sum()
    )


def eigen(data, n_vertices, subdivisions=0, repeat=3, k=K):
    mesh = model(data, n_vertices, subdivisions)
    stiffness, mass = laplacian(mesh)
    spectrum = eigenpairs(stiffness, mass, k, positions=mesh.vertices)
    weighted = mass[:, None] * spectrum.eigenfunctions
    error = stiffness @ spectrum.eigenfunctions - weighted * spectrum.eigenvalues
    # Relative residual ‖Lφ − λMφ‖ / λ in the norm of M⁻¹, in which the problem is self-adjoint
    residual = np.sqrt(np.einsum("vk,vk->k", error, error / mass[:, None])) / spectrum.eigenvalues
    return against(
        "scipy eigsh",
        lambda: eigenpairs(stiffness, mass, k, positions=mesh.vertices),
        lambda: by_eigsh(stiffness, mass, k),
        repeat,
        f"{k} pairs, {len(mesh.vertices)} vertices, largest relative residual {residual.max():.1e}",
    )


def eigen_against_lapy(data):
    from lapy import Solver, TriaMesh

    mesh = model(data, 11_000)
    vertices = np.array(mesh.vertices)
    faces = np.array(mesh.faces)

    def ours():
        stiffness, mass = laplacian(mesh)
        eigenpairs(stiffness, mass, K, positions=mesh.vertices)

    return against(
        "LaPy",
        ours,
        lambda: Solver(TriaMesh(vertices, faces)).eigs(K + 1),
        note="matrices and eigenpairs",
    )


def eigen_against_robust(data):
    import robust_laplacian

    mesh = model(data, 11_000)
    vertices = np.array(mesh.vertices)
    faces = np.array(mesh.faces)

    def ours():
        stiffness, mass = laplacian(mesh, "robust")
        eigenpairs(stiffness, mass, K, positions=mesh.vertices)

    def theirs():
        stiffness, mass = robust_laplacian.mesh_laplacian(vertices, faces)
        by_eigsh(stiffness.tocsr(), mass.diagonal())

    return against(
        "robust-laplacian + eigsh", ours, theirs, note="intrinsic-Delaunay matrices and eigenpairs"
    )


def coordinates_25k(data):
    mesh = model(data, 25_273)
    stiffness, mass = laplacian(mesh)
    spectrum = eigenpairs(stiffness, mass, K, positions=mesh.vertices)
    points = interior_samples(mesh)

    def evaluate(accuracy):
        return extend(mesh.vertices, mesh.faces, spectrum.eigenfunctions, points, accuracy=accuracy)

    embedding = [
        torch.from_numpy(evaluate(a) / np.sqrt(spectrum.eigenvalues)) for a in (None, 1e-3)
    ]
    exact, hybrid = (torch.pdist(e) for e in embedding)
    error = torch.quantile(((hybrid - exact).abs() / exact)[:: len(exact) // 1_000_000 + 1], 0.99)
    note = f"{len(points)} samples, 99 % of interior distances within {error:.1e}"
    return against("our exact evaluation", lambda: evaluate(1e-3), lambda: evaluate(None), 2, note)


def voxels_128(data):
    import igl

    mesh = model(data, 25_273)
    axes = grid_axes(mesh, 128)
    count = int(np.prod([len(axis) for axis in axes]))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)[:: count // 2000]
    vertices = np.array(mesh.vertices)
    faces = np.array(mesh.faces)
    seconds, sample = timed(
        lambda: inside_grid(mesh, axes), lambda: igl.winding_number(vertices, faces, points)
    )
    reference = sample * count / len(points)
    note = (
        f"{len(mesh.faces)} faces, {count} cells; the baseline scaled up from {len(points)} cells"
    )
    return Figure(seconds, "s", reference, "libigl winding number", reference / seconds, note)


def winding_25k_exact(data):
    import igl

    mesh = model(data, 25_273)
    points = interior_samples(mesh)
    vertices = np.array(mesh.vertices)
    faces = np.array(mesh.faces)
    return against(
        "libigl winding number",
        lambda: winding_number(mesh.vertices, mesh.faces, points),
        lambda: igl.winding_number(vertices, faces, points),
        note=f"to rounding, at {len(points)} scattered points",
    )


def histogram_pairs(data):
    embedding = torch.randn(4096, K, generator=torch.Generator().manual_seed(0)) * 0.06
    potential = embedding.norm(dim=1)

    def plain():
        return torch.histc(torch.pdist(embedding), 64, 0, 4)

    pair_histogram(embedding, potential)  # compiled at the first call
    seconds, reference = timed(lambda: pair_histogram(embedding, potential), plain, 5)
    pairs = len(embedding) * (len(embedding) - 1) / 2e6
    note = "baseline: distances alone and one hard histogram, no classes"
    return Figure(
        pairs / seconds,
        "M pairs/s",
        pairs / reference,
        "torch pdist + histc",
        reference / seconds,
        note,
    )


def histogram_backward(data):
    embedding = torch.randn(4096, K, generator=torch.Generator().manual_seed(0)) * 0.06
    potential = embedding.norm(dim=1)
    classes = Potential(4, learnable=True)
    bins = InteriorDistance(64, learnable=True)
    upstream = torch.randn(10, 64, generator=torch.Generator().manual_seed(1))
    centres = torch.linspace(0.03, 3.97, 64, requires_grad=True)
    small = embedding[:1024]

    def ours():
        distances = axes.euclidean_distances(embedding, bins.centres())
        (joint_histogram(classes.memberships(potential), [distances]) * upstream).sum().backward()

    def by_autograd():
        # The same kernel without classes, by autograd on an array (pairs, bins), for a sixteenth of the pairs
        position = torch.pdist(small)[:, None] - centres
        (torch.relu(1 - position.abs() * 16).sum(dim=0) * upstream[0]).sum().backward()

    seconds, reference = timed(ours, by_autograd, 5)
    rate = 4096 * 4095 / 2e6 / seconds
    reference = 1024 * 1023 / 2e6 / reference
    note = "forward and backward to all centres, soft classes; baseline: one class, 1,024 points"
    return Figure(rate, "M pairs/s", reference, "dense autograd", rate / reference, note)


def chi_square_distances(data):
    from sklearn.metrics.pairwise import additive_chi2_kernel

    histograms = torch.rand(2000, 512, generator=torch.Generator().manual_seed(0))
    histograms /= histograms.sum(dim=1, keepdim=True)
    chi_square(histograms[:2], histograms[:2])  # compiled at the first call
    return against(
        "scikit-learn additive_chi2_kernel",
        lambda: chi_square(histograms, histograms),
        lambda: additive_chi2_kernel(histograms.numpy(), histograms.numpy()),
        note="2,000 histograms of 512 cells, all pairs",
    )


def euclidean_distances(data):
    vectors = torch.randn(4000, 252, generator=torch.Generator().manual_seed(0))
    euclidean(vectors[:2], vectors[:2])  # compiled at the first call
    return against(
        "torch cdist",
        lambda: euclidean(vectors, vectors),
        lambda: torch.cdist(vectors, vectors, compute_mode="donot_use_mm_for_euclid_dist"),
        note="4,000 vectors of 252 numbers, all pairs; baseline: of the same accuracy, without matrix products",
    )


def oriented_pairs(data):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(1000, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(1000, 3, generator=generator), dim=1)
    one_class = torch.ones(1000, 1)
    distances = axes.euclidean_distances(points, interval_centres(6, 1.0, "bins"))
    cosines = interval_centres(5, 2.0, "bins") - 1
    oriented = axes.oriented_pairs(points, directions, cosines, cosines)
    x = points.double().numpy()
    n = directions.double().numpy()
    i, j = np.triu_indices(1000, 1)

    def ours():
        with torch.inference_mode():
            joint_histogram(one_class, [distances, oriented])

    def by_numpy():
        line = x[j] - x[i]
        distance = np.linalg.norm(line, axis=1)
        a, b = ((sign * n[end] * line).sum(axis=1) / distance for sign, end in ((1, i), (-1, j)))
        features = np.stack(
            [distance, np.maximum(a, b), np.minimum(a, b), (n[i] * n[j]).sum(axis=1)], axis=1
        )
        np.histogramdd(features, (6, 5, 5, 5), [(0, 1), (-1, 1), (-1, 1), (-1, 1)])

    ours()  # compiled at the first call
    seconds, reference = timed(ours, by_numpy, 5)
    pairs = len(i) / 1e6
    note = "four linear kernels; baseline: nearest bins"
    return Figure(
        pairs / seconds,
        "M pairs/s",
        pairs / reference,
        "numpy histogramdd",
        reference / seconds,
        note,
    )


def describe_before(data):
    """Processor time for the description of a signature on one thread, against commit 8140bb3."""
    mesh = model(data, 10_000)
    requirements = igps.descriptor("multiscale").requirements | igps.descriptor("rich").requirements
    signature = igps.compute_signature(mesh, requirements.apply_to(igps.SignatureConfig()))
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "signature.npz"
        save_signature(signature, path)
        with two_versions("describing.py", path, BEFORE) as seconds_of:
            for name in ("rich", "pretrained", "multiscale", "interior", "gps"):
                ours, before = seconds_of(name)
                note = f"{len(signature.interior)} and {len(signature.surface)} samples"
                figures[f"describe_{name}"] = Figure(
                    ours, "s", before, f"commit {BEFORE}", before / ours, note
                )
    return figures


def signature_1500(data):
    """The signature of a small body as `pretrained` requires it, on one thread, against version 0.2.0."""
    mesh = model(data, 1_500)
    config = igps.descriptor("pretrained").requirements.apply_to(igps.SignatureConfig())
    n_samples = len(igps.compute_signature(mesh, config).interior)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "body.npz"
        np.savez(path, vertices=mesh.vertices, faces=mesh.faces)
        with two_versions("signing.py", path, VERSION_0_2_0) as seconds_of:
            parameters = asdict(config)
            del parameters["measures"]  # which version 0.2.0 does not know
            ours, before = seconds_of(json.dumps(parameters))
    note = f"{len(mesh.vertices)} vertices, {n_samples} samples"
    return Figure(ours, "s", before, "version 0.2.0", before / ours, note)


def epoch(data):
    """An epoch over 400 stored signatures, without and with workers, against version 0.2.0 and each other."""
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "meshes"
        igps.ArticulatedShapes(n_classes=4, n_per_class=5, n_vertices=1500).write(root)
        with two_versions("epochs.py", root, VERSION_0_2_0) as seconds_of:
            without_workers, before = seconds_of("0")
            with_workers, before_with_workers = seconds_of("2")
    note = "400 items of 20 generated bodies, batches of 16"
    figures["epoch"] = Figure(
        without_workers, "s", before, "version 0.2.0", before / without_workers, note
    )
    ratio = before_with_workers / with_workers
    figures["epoch_workers"] = Figure(
        with_workers, "s", before_with_workers, "version 0.2.0", ratio, "two workers"
    )
    ratio = without_workers / with_workers
    figures["epoch_helped"] = Figure(
        with_workers, "s", without_workers, "no worker", ratio, "two workers"
    )
    return figures


def learned_step(data):
    """A training step of `rich` with learnable bins, 40 shapes of 400 samples, on one thread, against version 0.2.0."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "meshes"
        igps.ArticulatedShapes(n_classes=4, n_per_class=5, n_vertices=1500).write(root)
        with two_versions("steps.py", root, VERSION_0_2_0) as seconds_of:
            ours, before = seconds_of("step")
    return Figure(
        ours, "s", before, "version 0.2.0", before / ours, "40 shapes, 400 samples of each"
    )


def together(data):
    """Processor time for the description of 32 bodies as one batch, on one thread, against batches of one body."""
    torch.set_num_threads(1)
    requirements = (
        igps.descriptor("interior").requirements | igps.descriptor("pretrained").requirements
    )
    with tempfile.TemporaryDirectory() as folder:
        igps.ArticulatedShapes(n_classes=8, n_per_class=4, n_vertices=1500).write(
            f"{folder}/meshes"
        )
        dataset = igps.SignatureDataset(
            f"{folder}/meshes", cache_dir=f"{folder}/cache", descriptor=requirements
        )
        signatures = dataset.to_memory()
    figures = {}
    for n_samples, amount in ((400, "400"), (None, "all")):
        bodies = signatures.to_memory(
            FewerSamples(n_interior=n_samples, n_surface=n_samples, seed=0)
        )
        batch = bodies.batch(range(len(bodies)))
        single_bodies = [bodies.batch([i]) for i in range(len(bodies))]
        for name in ("interior", "pretrained"):
            descriptor = igps.descriptor(name)

            def seconds(batches, descriptor=descriptor):
                start = time.process_time()
                with torch.no_grad():
                    for batch in batches:
                        descriptor(batch)
                return time.process_time() - start

            ours, before = timed_by(lambda: seconds([batch]), lambda: seconds(single_bodies), 5)  # noqa: B023
            note = f"32 generated bodies, {amount} samples"
            figures[f"together_{name}_{amount}"] = Figure(
                ours, "s", before, "one by one", before / ours, note
            )
    return figures


@contextlib.contextmanager
def two_versions(script, path, commit):
    """Run a script of this folder with the current igps and with that of a commit, each on one thread.

    Gives a function from a line of input to the seconds that both scripts print, medians of seven repetitions.
    """
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        archive = subprocess.run(
            ["git", "archive", commit, "src"], check=True, capture_output=True, cwd=PROJECT
        ).stdout
        subprocess.run(["tar", "x", "-C", folder], check=True, input=archive)
        processes = []
        for source in (PROJECT / "src", Path(folder) / "src"):
            environment = {**os.environ, **one_thread, "PYTHONPATH": str(source)}
            process = subprocess.Popen(
                [sys.executable, str(Path(__file__).with_name(script)), str(path)],
                text=True,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=environment,
            )
            stack.enter_context(process)
            processes.append(process)

        def seconds_of(line):
            seconds = ([], [])
            for _ in range(7):
                for times, process in zip(seconds, processes, strict=True):
                    print(line, file=process.stdin, flush=True)
                    times.append(float(process.stdout.readline()))
            return median(seconds[0]), median(seconds[1])

        yield seconds_of
        for process in processes:
            process.stdin.close()


def descriptor_15k(data):
    """Growth of the peak memory by the histogram of a body of 15,000 samples, which have 112 million pairs."""
    embedding = torch.randn(15_000, K, generator=torch.Generator().manual_seed(0)) * 0.06
    potential = embedding.norm(dim=1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    pair_histogram(embedding, potential)
    growth = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20 - before
    return Figure(
        growth,
        "GiB",
        1.0,
        "target",
        1.0 / max(growth, 1e-3),
        "memory beyond the embedding's own 14 MiB",
    )


def mesh_to_histogram(mesh):
    start = time.perf_counter()
    signature = igps.compute_signature(mesh, igps.SignatureConfig.paper())
    igps.descriptor("interior")(igps.collate([signature]))
    return time.perf_counter() - start


def mesh_10k(data):
    mesh = model(data, 10_000)
    note = f"{len(mesh.vertices)} vertices; the paper reports about 200 s on its machine"
    return within(1.5, min(mesh_to_histogram(mesh) for _ in range(3)), note)


def mesh_250k(data):
    mesh = model(data, 250_000, 2)
    return within(12, mesh_to_histogram(mesh), f"{len(mesh.vertices)} vertices")


def mesh_1m(data):
    mesh = model(data, 1_000_000, 3)
    return within(90, mesh_to_histogram(mesh), f"{len(mesh.vertices)} vertices, in 6 GiB at most")


def shrec07(data):
    """Retrieval of all models by the command line: without cache against commit BEFORE, and from the cache."""
    if data is None:
        return {}
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        before = Path(folder) / "before"
        before.mkdir()
        archive = subprocess.run(
            ["git", "archive", BEFORE, "src"], check=True, capture_output=True, cwd=PROJECT
        ).stdout
        subprocess.run(["tar", "x", "-C", before], check=True, input=archive)
        environment_before = {**os.environ, "PYTHONPATH": str(before / "src")}

        def retrieve(descriptor, option, cache, environment=None):
            command = [
                sys.executable,
                "-m",
                "igps.cli",
                "retrieve",
                str(data),
                "--descriptor",
                descriptor,
            ]
            command += [option, str(Path(folder) / cache)]
            return _seconds(
                lambda: subprocess.run(command, check=True, capture_output=True, env=environment)
            )

        for name in ("interior", "pretrained"):
            seconds = retrieve(name, "--cache_dir", name)
            reference = retrieve(name, "--cache", f"{name} before", environment_before)
            figures[f"shrec07_{name}"] = Figure(
                seconds, "s", reference, f"commit {BEFORE}", reference / seconds
            )
        figures["shrec07_warm"] = within(
            10, retrieve("interior", "--cache_dir", "interior"), "interior"
        )
        shutil.rmtree(Path(folder) / "interior" / "descriptions")
        seconds = retrieve("interior", "--cache_dir", "interior")
        figures["shrec07_described"] = within(
            20, seconds, "interior, with signatures but no descriptions in the cache"
        )
    return figures


def company(data):
    """Each task beside two busy processes: with the library's choice of threads, against one thread.

    Libraries read their number of threads when they are loaded. So each setting has a worker process, and one waits for
    input while the other one computes.
    """
    one_thread = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    default = {
        name: value
        for name, value in os.environ.items()
        if name not in (*one_thread, "OMP_WAIT_POLICY")
    }
    figures = {}
    with contextlib.ExitStack() as stack:
        ours, single = (
            stack.enter_context(worker(data, env)) for env in (default, {**default, **one_thread})
        )
        for _ in range(2):
            stack.enter_context(busy())
        for task in COMPANY:
            seconds, reference = timed_by(
                lambda task=task: ours(task), lambda task=task: single(task), 5
            )
            slowdown = seconds / reference
            note = f"{seconds:.2f} s beside two busy processes, {reference:.2f} s with one thread"
            figures[f"company_{task}"] = Figure(slowdown, "×", 1.5, "target", 1.5 / slowdown, note)
    return figures


@contextlib.contextmanager
def busy():
    """Run a process that keeps a core busy."""
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        yield
    finally:
        process.kill()
        process.wait()


@contextlib.contextmanager
def worker(data, environment):
    """Start a process that runs tasks of `COMPANY`. Gives a function from the name of a task to its seconds."""
    command = [sys.executable, __file__, "--worker"] + (["--data", str(data)] if data else [])
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    )
    assert process.stdin is not None
    assert process.stdout is not None
    write = process.stdin
    read = process.stdout

    def run(task):
        print(task, file=write, flush=True)
        return float(read.readline())

    with process:
        try:
            for task in COMPANY:  # the first run loads libraries and compiles functions
                run(task)
            yield run
        finally:
            write.close()


def work(data):
    """Run tasks by the names on standard input, and print the seconds of each; the main function of a `worker`."""
    mesh = model(data, 3_600)
    descriptor = igps.descriptor("rich")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "body.off"
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
        dataset = igps.SignatureDataset([path], descriptor=descriptor, cache_dir=folder)
        step = training_step(igps.collate([dataset[0]] * 4))
        tasks = {
            "signature": lambda: igps.compute_signature(mesh),
            "describe": lambda: igps.describe(dataset, descriptor),
            "step": step,
        }
        for line in sys.stdin:
            print(_seconds(tasks[line.strip()]), flush=True)


COMPANY = ("signature", "describe", "step")


def training_step(batch):
    """A training step by Lightning, with loss, gradients and update, on four shapes of two classes."""
    from pytorch_lightning import Trainer
    from torch.utils.data import DataLoader

    from igps.nn.heads.learned import BlendedDistance, ProjectionHead

    axes = [Potential(4, learnable=True), InteriorDistance(64, learnable=True)]
    embedding = igps.SpectralEmbedding(n_eigenpairs=64, n_knots=12)
    descriptor = igps.HistogramDescriptor(igps.PairHistogram(axes, embedding))
    learner = igps.RetrievalLearner(
        descriptor, BlendedDistance(ProjectionHead(width=16, n_hidden=32))
    )
    batch = replace(batch, labels=torch.tensor([0, 0, 1, 1]))
    loader = DataLoader([batch], batch_size=None)
    learner.on_train_start = lambda: None  # a step does not include the fit of the head
    learner.on_train_epoch_end = lambda: None

    def step():
        trainer = Trainer(
            max_steps=1,
            accelerator="cpu",
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            limit_val_batches=0,
        )
        trainer.fit(learner, loader)

    return step


def starting(data):
    """Time of `import igps` beyond `import torch`, and of the command line's help."""

    def run(*arguments):
        return lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True)

    ours, torch_alone = timed(run("-c", "import igps"), run("-c", "import torch"), 5)
    help_seconds, _ = timed(run("-m", "igps", "--help"), run("-c", ""), 5)
    difference = max(ours - torch_alone, 1e-3)
    note = f"beyond the {torch_alone:.2f} s of `import torch`"
    return {"import_igps": within(1.5, difference, note), "igps_help": within(3, help_seconds)}


FIGURES = {
    "eigen_11k": lambda data: eigen(data, 11_000),
    "eigen_25k": lambda data: eigen(data, 25_273),
    "eigen_100k": lambda data: eigen(data, 101_092, 1, repeat=1),
    "eigen_64_11k": lambda data: eigen(data, 11_000, k=64),
    "eigen_64_25k": lambda data: eigen(data, 25_273, k=64),
    "eigen_11k_lapy": eigen_against_lapy,
    "eigen_11k_robust": eigen_against_robust,
    "coordinates_25k": coordinates_25k,
    "winding_25k_exact": winding_25k_exact,
    "voxels_128": voxels_128,
    "histogram_pairs": histogram_pairs,
    "histogram_backward": histogram_backward,
    "chi_square": chi_square_distances,
    "euclidean": euclidean_distances,
    "oriented_pairs": oriented_pairs,
    "describe_rich": describe_before,
    "signature_1500": signature_1500,
    "learned_step": learned_step,
    "epoch": epoch,
    "together": together,
    "descriptor_15k": descriptor_15k,
    "mesh_10k": mesh_10k,
    "mesh_250k": mesh_250k,
    "mesh_1m": mesh_1m,
    "company": company,
    "import": starting,
    "shrec07": shrec07,
}
# The peak memory of these figures is that of the processes that they start.
WITH_PROCESSES = ("company", "import", "shrec07")


def run_one(name, data):
    result = FIGURES[name](data)
    figures = result if isinstance(result, dict) else {name: result}
    processes = resource.RUSAGE_CHILDREN if name in WITH_PROCESSES else resource.RUSAGE_SELF
    peak = resource.getrusage(processes).ru_maxrss / 2**20
    columns = {"peak_gib": peak, "spread": max(spreads, default=0.0)}
    print(json.dumps({key: {**asdict(figure), **columns} for key, figure in figures.items()}))


def least_disturbed(name, data):
    """Measure the rows of a figure, again if the measurement was disturbed."""
    command = [sys.executable, __file__, "--here", name] + (["--data", str(data)] if data else [])
    best = {}
    min_disturbance = float("inf")
    for attempt in range(1, ATTEMPTS + 1):
        machine = Machine()
        process = subprocess.run(command, capture_output=True, text=True)
        if process.returncode:
            sys.exit(f"{name}: failed\n{process.stderr}")
        rows = json.loads(process.stdout.splitlines()[-1])
        steal = machine.steal()
        spread = max((row["spread"] for row in rows.values()), default=0.0)
        disturbance = max(spread / SPREAD, steal / STEAL)
        if disturbance < min_disturbance or not best:
            min_disturbance = disturbance
            best = rows
            for row in best.values():
                row.update(load=machine.load(), steal=steal)
        for row in best.values():
            row["attempts"] = attempt
        if not disturbance > 1:
            break
    return best


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="folder of the SHREC'07 meshes")
    parser.add_argument("--out", type=Path, default=Path("build/bench.json"))
    parser.add_argument("--only", nargs="+", choices=FIGURES, default=list(FIGURES))
    parser.add_argument("--here", choices=FIGURES, help=argparse.SUPPRESS)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        work(options.data)
        return
    if options.here:
        run_one(options.here, options.data)
        return
    table = {}
    print(
        f"{os.cpu_count()} cores, of which {n_cores()} may be used; load average {Machine().load():.1f}"
    )
    print(
        f"{'figure':<18}{'value':>10} {'unit':<10}{'baseline':>10}  {'ratio':>7}  {'peak':>9}  {'load':>5}  "
        f"{'steal':>5}  {'spread':>6}  baseline; note"
    )
    for name in options.only:
        for key, row in least_disturbed(name, options.data).items():
            table[key] = row
            attempts = f"; measured {row['attempts']} times" if row["attempts"] != 1 else ""
            print(
                f"{key:<18}{row['value']:>10.3g} {row['unit']:<10}{row['baseline']:>10.3g}  {row['ratio']:>6.1f}×  "
                f"{row['peak_gib']:>5.2f} GiB  {row['load']:>5.1f}  {row['steal']:>5.0%}  {row['spread']:>6.0%}  "
                f"{row['baseline_name']}; {row['note']}{attempts}",
                flush=True,
            )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(table, indent=2) + "\n")
    print(f"written to {options.out}")


if __name__ == "__main__":
    main()
