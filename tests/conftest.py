"""Meshes and data that several tests use."""

import contextlib
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from matplotlib.figure import Figure
from threadpoolctl import threadpool_limits

from igps.mesh.loading import load_mesh
from igps.mesh.mesh import Mesh
from igps.signature import mean_value as coordinates
from page_packages import install

# The meshes are small: on two threads they are hardly faster, and many times slower where another process takes a core.
torch.set_num_threads(1)
os.environ.setdefault("OMP_NUM_THREADS", "1")


def set_blas_threads(number):
    """Of libraries that are loaded already: others heed the variable.

    As long as the thread that set a number lives, threadpoolctl heeds no other, so one sets it that ends.
    """
    with ThreadPoolExecutor(1) as pool:
        pool.submit(threadpool_limits, number, "blas").result()


set_blas_threads(1)

SHARED = Path(__file__).parents[2] / "shared"


TETRAHEDRON = np.array(
    [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
    dtype=float,
)
FACES = np.array(
    [
        [0, 2, 1],
        [0, 1, 3],
        [1, 2, 3],
        [0, 3, 2],
    ]
)


@pytest.fixture(autouse=True, scope="session")
def one_core(tmp_path_factory):
    """As in a container of one core: to start processes takes longer than the work of most tests.

    Tests of several processes say how many.
    """
    quota = tmp_path_factory.mktemp("container") / "cpu.max"
    quota.write_text("100000 100000")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("igps._threads.CPU_QUOTA", quota)
        yield


@pytest.fixture
def many_cores(monkeypatch):
    """As on a machine of eight cores."""
    monkeypatch.setattr("igps._threads.n_cores", lambda: 8)


@pytest.fixture
def without_loops(monkeypatch):
    """Describe by operations of PyTorch, as on a GPU."""
    monkeypatch.setattr("igps.nn._kernels.batches.uses_loops", lambda _: False)


@pytest.fixture
def trust_recent_files(monkeypatch):
    """Tests cannot set the time of the last change of a file's metadata (ctime)."""
    for module in ("data.known_files", "gallery.rows"):
        monkeypatch.setattr(f"igps.{module}.MIN_AGE", 0)


@pytest.fixture
def nothing_is_computed(monkeypatch):
    """Fail where signatures are computed."""

    def precompute(*arguments, **options):
        pytest.fail("signatures are computed")

    monkeypatch.setattr("igps.data.dataset.SignatureDataset.precompute", precompute)


@pytest.fixture
def own_commands(on_path):
    """The commands of `own_commands`, as an installed package brings them."""
    names = "".join(f'{name} = "own_commands:{name}"\n' for name in ("wait", "ask", "pose"))
    project = '[project]\nname = "own"\nversion = "1"\n'
    install(f'{project}[project.entry-points."igps.commands"]\n{names}', on_path)


@pytest.fixture
def here(tmp_path):
    """The folder of the test as the current one."""
    with contextlib.chdir(tmp_path):
        yield tmp_path


@pytest.fixture
def on_path(tmp_path, monkeypatch):
    """A folder on the Python path."""
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


@pytest.fixture
def figures_of(monkeypatch):
    """A function from a module to the list of figures that it makes from now on."""

    def remembered(module):
        made = list[Figure]()
        make = module.new_figure

        def remember(width, height):
            made.append(make(width, height))
            return made[-1]

        monkeypatch.setattr(module, "new_figure", remember)
        return made

    return remembered


@contextlib.contextmanager
def torch_threads(n_threads):
    """Set the number of PyTorch threads inside the context, and restore it afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(n_threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def as_mesh(surface, name="mesh"):
    return Mesh(
        np.asarray(surface.vertices),
        np.asarray(surface.faces),
        name=name,
    )


def as_trimesh(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def tube(rings, ends):
    """A tube through rings of points (R, N, 3), closed by fans about two end points (2, 3)."""
    n_rings, n_around, _ = rings.shape
    i, j = np.mgrid[: n_rings - 1, :n_around]
    a = i * n_around + j
    b = i * n_around + (j + 1) % n_around
    lower = np.stack([a, a + n_around, b], axis=-1)
    upper = np.stack([b, a + n_around, b + n_around], axis=-1)
    here = np.arange(n_around)
    there = (here + 1) % n_around
    last = (n_rings - 1) * n_around
    middle = np.full(n_around, n_rings * n_around)
    first_cap = np.stack([here, there, middle], axis=1)
    last_cap = np.stack([last + there, last + here, middle + 1], axis=1)
    faces = [part.reshape(-1, 3) for part in (lower, upper, first_cap, last_cap)]
    return Mesh(np.concatenate([rings.reshape(-1, 3), ends]), np.concatenate(faces))


def horseshoe(half_gap=0.05, radius=0.3, n_sections=48, n_around=14):
    """A ring that is open by twice `half_gap` radians, with flat ends, without any symmetry."""
    jitter = np.random.default_rng(0).uniform(0.9, 1.1, (n_sections, n_around))
    u = np.linspace(half_gap, 2 * np.pi - half_gap, n_sections)[:, None]
    v = np.arange(n_around)[None, :] * (2 * np.pi / n_around)
    away = 1 + radius * jitter * np.cos(v)
    rings = np.stack([away * np.cos(u), away * np.sin(u), radius * jitter * np.sin(v)], axis=2)
    ends = np.stack([np.cos(u[[0, -1], 0]), np.sin(u[[0, -1], 0]), np.zeros(2)], axis=1)
    return replace(tube(rings, ends), name="horseshoe")


def with_slivers(vertices, faces, n_slivers):
    """The same surface, with so many random faces cut in three by a vertex hardly off the middle of a side."""
    split = np.random.default_rng(3).choice(len(faces), n_slivers, replace=False)
    inside = np.einsum("i,fij->fj", [0.4995, 0.4995, 0.001], vertices[faces[split]])
    new = len(vertices) + np.arange(n_slivers)
    a, b, c = faces[split].T
    thirds = [np.stack(corners, axis=1) for corners in ((a, b, new), (b, c, new), (c, a, new))]
    kept = np.delete(faces, split, axis=0)
    return np.concatenate([vertices, inside]), np.concatenate([kept, *thirds])


def surface_genus(mesh):
    """Handles of a watertight mesh as trimesh counts them."""
    surface = as_trimesh(mesh)
    assert surface.is_watertight
    assert surface.is_winding_consistent
    return 1 - surface.euler_number // 2


@pytest.fixture
def approximate_small_meshes():
    """Else small meshes are evaluated more accurately, without clusters. It outlives a test's `monkeypatch.undo`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(coordinates, "_MIN_FINE_VERTICES", 0)
        patch.setattr(coordinates, "_MIN_CLUSTER_VERTICES", 0)
        yield


@pytest.fixture(scope="session")
def sphere():
    """The unit sphere with 2,562 vertices."""
    return as_mesh(trimesh.creation.icosphere(subdivisions=4), "sphere")


@pytest.fixture(scope="session")
def blob():
    """A small smooth body without symmetry, 642 vertices: its eigenvalues are well apart."""
    surface = trimesh.creation.icosphere(subdivisions=3)
    x, y, z = surface.vertices.T
    radius = 1 + 0.25 * x + 0.2 * np.sin(2.3 * y + 0.4) + 0.15 * x * z
    surface.vertices *= radius[:, None] * [1.0, 0.8, 1.3]
    return as_mesh(surface, "blob")


@pytest.fixture(scope="session")
def homer():
    path = SHARED / "data" / "homer.obj"
    if not path.is_file():
        pytest.skip("the Homer model is not distributed with the project: ../shared/data")
    return load_mesh(path)
