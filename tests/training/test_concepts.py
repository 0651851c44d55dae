"""The pictures of concepts.md show what NumPy and SciPy compute from dense matrices and exact coordinates."""

import itertools
import re

import numpy as np
import pytest
import scipy.linalg
import trimesh
from docs import concepts
from docs.benchmarks.weld import facing_vertices, weld
from matplotlib.colors import to_hex
from matplotlib.image import imread
from numpy.testing import assert_allclose
from scipy.spatial.distance import pdist

from bodies import mean_value_coordinates
from conftest import horseshoe
from igps.data.dataset import SignatureDataset
from igps.mesh.loading import load_mesh
from igps.mesh.mesh import Mesh
from igps.signature.laplacian import laplacian
from igps.signature.voxels import interior_samples
from own_descriptors import CONFIG


@pytest.fixture
def root(tmp_path):
    """Two balls, three long eggs and a rod."""
    for label, ratios in (("ball", (1.0, 1.1)), ("egg", (2.0, 2.1, 2.2)), ("rod", (4.0,))):
        for i, ratio in enumerate(ratios):
            body = trimesh.creation.icosphere(subdivisions=2)
            body.vertices *= [1, 1, ratio]
            path = tmp_path / "meshes" / label / f"{i}.off"
            path.parent.mkdir(parents=True, exist_ok=True)
            body.export(path)
    return tmp_path / "meshes"


@pytest.fixture
def open_ring(tmp_path):
    """A tube along most of a circle, its flat ends close together, in a file."""
    mesh = horseshoe(0.06, n_sections=36, n_around=10)
    path = tmp_path / "ring.off"
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path, digits=17)
    return path


@pytest.fixture
def drawn(figures_of):
    """The figures that were made."""
    return figures_of(concepts)


def embedding(mesh, points, n_eigenpairs):
    """The first three eigenvalues, and the commute-time embedding by dense linear algebra."""
    stiffness, mass = laplacian(mesh)
    values, functions = scipy.linalg.eigh(
        stiffness.toarray(),
        np.diag(mass),
    )
    kept = slice(1, n_eigenpairs + 1)
    weights = np.asarray(mean_value_coordinates(mesh.vertices, mesh.faces, points))
    return weights @ (functions[:, kept] / np.sqrt(values[kept]))


def chi_square(a, b):
    return float(np.sum((a - b) ** 2 / np.maximum(a + b, 1e-300)) / 2)


def histogram(dataset, name):
    """The share of pairs in bins of 1/16 up to 4; each pair is shared by the bins whose centres surround it."""
    signature = dataset[dataset.bodies.names.index(name)].signature
    distances = pdist(signature.interior.eigenfunctions / np.sqrt(signature.eigenvalues))
    position = np.clip(distances * 16 - 0.5, 0, 63)
    lower = np.floor(position).astype(int)
    share = position % 1
    counts = np.bincount(lower, 1 - share, 65) + np.bincount(lower + 1, share, 65)
    return counts[:64] / len(distances)


def test_pose_draws_the_histogram_of_every_mesh(root, tmp_path, drawn, capsys):
    out = tmp_path / "new" / "pose.png"
    cache = tmp_path / "cache"
    concepts.pose(root, ["egg", "ball"], out, CONFIG, cache)
    printed = capsys.readouterr().out
    assert imread(out).std() > 0.05
    (axes,) = drawn[0].axes
    lines = axes.get_lines()
    titles = [text.get_text() for text in axes.get_legend().get_texts()]
    assert titles == ["egg (3 bodies)", "ball (2 bodies)"]
    colours = [to_hex(line.get_color()) for line in lines]
    assert colours[0] == colours[1] == colours[2] != colours[3] == colours[4]
    assert "interior distance" in axes.get_xlabel()
    assert "%" in axes.get_ylabel()

    dataset = SignatureDataset(root, CONFIG, cache)
    eggs = [histogram(dataset, f"egg/{i}.off") for i in range(3)]
    balls = [histogram(dataset, f"ball/{i}.off") for i in range(2)]
    centres = (np.arange(64) + 0.5) / 16
    for line, curve in zip(lines, eggs + balls, strict=True):
        assert_allclose(line.get_xdata(), centres, rtol=1e-6)
        assert_allclose(line.get_ydata(), 100 * curve, atol=0.02)
    within = np.median([chi_square(*pair) for pair in itertools.combinations(eggs, 2)])
    others = np.median([chi_square(*pair) for pair in itertools.product(eggs, balls)])
    (row,) = re.findall(r"^egg 3 (\S+) (\S+)$", printed, re.MULTILINE)
    assert float(row[0]) == pytest.approx(within, abs=2e-3)
    assert float(row[1]) == pytest.approx(others, abs=2e-3)
    assert others > 3 * within


def test_topology_measures_the_change_of_the_same_pairs(open_ring, tmp_path, capsys):
    out = tmp_path / "topology.png"
    concepts.topology(open_ring, None, out, n_eigenpairs=30, resolution=16)
    printed = capsys.readouterr().out
    before = load_mesh(open_ring)
    a, b = facing_vertices(before)
    after = weld(before, a, b)
    points = interior_samples(before, 16)
    distances = [pdist(embedding(mesh, points, 30)) for mesh in (before, after)]
    change = 100 * np.abs(distances[1] / distances[0] - 1)
    assert change.max() > 20  # once around the ring is no longer the only way
    assert f"welded at vertices {a} and {b}" in printed
    assert f"{len(points)} interior samples, {len(change)} pairs, 30 eigenpairs" in printed
    for limit in (3, 10, 14):
        (share,) = re.findall(rf"less than {limit} %: (\S+) %", printed)
        expected = pytest.approx(
            100 * np.mean(change < limit),
            abs=0.2,
        )
        assert float(share) == expected
    (largest,) = re.findall(r"largest change: (\S+) %", printed)
    assert float(largest) == pytest.approx(change.max(), rel=0.01)
    stiffness, mass = laplacian(after)
    eigenvalues = scipy.linalg.eigvalsh(stiffness.toarray(), np.diag(mass))[1:4]
    rows = re.findall(r"genus (\d), first eigenvalues (.*)$", printed, re.MULTILINE)
    assert [genus for genus, _ in rows] == ["0", "1"]
    assert [float(x) for x in rows[1][1].split(", ")] == pytest.approx(eigenvalues, rel=1e-3)

    assert imread(out).std() > 0.05


def test_potential_is_least_in_the_middle(tmp_path):
    body = trimesh.creation.icosphere(subdivisions=3)
    body.vertices = body.vertices * [0.7, 2, 1] + [5, 6, 7]
    path = tmp_path / "egg.off"
    body.export(path, digits=17)
    mesh = load_mesh(path)
    # The longest axis, y, is up and the next, z, to the right.
    turned = Mesh(concepts.upright(mesh.vertices), mesh.faces)
    found = concepts.potential_slice(turned, n_eigenpairs=40, resolution=32)
    centre = found.barycentroid
    assert_allclose(np.abs(centre), [7, 6], atol=0.02)
    x, y = found.axes
    grid_x, grid_y = np.meshgrid(
        x - centre[0],
        y - centre[1],
        indexing="ij",
    )
    ellipse = np.sqrt(grid_x**2 + (grid_y / 2) ** 2)
    inside = ~np.isnan(found.values)
    assert inside[ellipse < 0.97].all()
    assert not inside[ellipse > 1.01].any()
    outline = np.linalg.norm(
        (found.section - centre) / [1, 2],
        axis=2,
    )
    assert outline == pytest.approx(1, abs=0.02)
    places = np.array([[5.0, 6.0, 7.0], [5.0, 7.5, 7.0]])
    exact = np.linalg.norm(
        embedding(mesh, places, 40),
        axis=1,
    )
    assert np.nanmin(found.values) == pytest.approx(exact[0], rel=0.01)
    i = int(np.argmin(np.abs(x - centre[0])))
    j = int(np.argmin(np.abs(y - centre[1] - 1.5)))
    assert found.values[i, j] == pytest.approx(exact[1], rel=0.03)

    concepts.potential(path, tmp_path / "potential.png", n_eigenpairs=40)
    assert imread(tmp_path / "potential.png").std() > 0.05
