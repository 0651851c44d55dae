"""`igps figure`: what it prints and draws is what NumPy and SciPy compute from dense matrices and exact coordinates."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import trimesh
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.image import imread
from numpy.typing import NDArray
from scipy.spatial.distance import pdist
from training.studies import paper_figures as paper
from training.studies.weld import TUBE_FACES, facing_vertices, weld
from training.study import main

from bodies import mean_value_coordinates
from conftest import horseshoe
from igps.data.dataset import SignatureDataset
from igps.mesh.loading import load_mesh
from igps.mesh.mesh import Mesh
from igps.signature.laplacian import laplacian
from igps.signature.signature import SignatureConfig
from igps.signature.voxels import interior_samples

SMALL = [
    "--signature.n_eigenpairs",
    "20",
    "--signature.resolution",
    "10",
    "--signature.min_samples",
    "0",
]
SMALL += ["--signature.n_surface_samples", "60", "--n_workers", "1"]
CONFIG = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=60)


@pytest.fixture
def root(tmp_path: Path) -> Path:
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
def open_ring(tmp_path: Path) -> Path:
    """A tube along most of a circle, its flat ends close together, in a file."""
    mesh = horseshoe(0.06, n_sections=36, n_around=10)
    path = tmp_path / "ring.off"
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path, digits=17)
    return path


@pytest.fixture
def drawn(figures_of: Callable[[Any], list[Figure]]) -> list[Figure]:
    """The figures that were made."""
    return figures_of(paper)


def igps(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", ["igps", *map(str, arguments)])
    main()


def embedding(mesh: Mesh, points: NDArray[np.float64], n_eigenpairs: int) -> NDArray[np.float64]:
    """The first three eigenvalues, and the commute-time embedding by dense linear algebra."""
    stiffness, mass = laplacian(mesh)
    values, functions = scipy.linalg.eigh(stiffness.toarray(), np.diag(mass))
    kept = slice(1, n_eigenpairs + 1)
    weights = np.asarray(mean_value_coordinates(mesh.vertices, mesh.faces, points))
    return weights @ (functions[:, kept] / np.sqrt(values[kept]))


def test_pose_draws_the_histogram_of_every_mesh(
    root: Path,
    tmp_path: Path,
    drawn: list[Figure],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "new" / "pose.png"
    arguments = ["--out", out, "--cache_dir", tmp_path / "cache", *SMALL]
    igps(monkeypatch, "figure", "pose", root, "--classes", "egg", "ball", *arguments)
    printed = capsys.readouterr().out
    assert imread(out).std() > 0.05
    (axes,) = drawn[0].axes
    lines = axes.get_lines()
    legend = axes.get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["egg (3 bodies)", "ball (2 bodies)"]
    colours = [to_hex(line.get_color()) for line in lines]
    assert colours[0] == colours[1] == colours[2] != colours[3] == colours[4]
    assert "interior distance" in axes.get_xlabel()
    assert "%" in axes.get_ylabel()

    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    expected = {}
    for i, name in enumerate(dataset.bodies.names):
        signature = dataset[i].signature
        distance = pdist(signature.interior.eigenfunctions / np.sqrt(signature.eigenvalues))
        # Each pair is shared by the two bins whose centres surround it; bins of 1/16 up to 4.
        position = np.clip(distance * 16 - 0.5, 0, 63)
        lower, share = np.floor(position).astype(int), position % 1
        histogram = np.bincount(lower, 1 - share, 65) + np.bincount(lower + 1, share, 65)
        expected[name] = histogram[:64] / len(distance)
    names = ["egg/0.off", "egg/1.off", "egg/2.off", "ball/0.off", "ball/1.off"]
    for line, name in zip(lines, names, strict=True):
        np.testing.assert_allclose(line.get_xdata(), (np.arange(64) + 0.5) / 16, rtol=1e-6)
        np.testing.assert_allclose(line.get_ydata(), 100 * expected[name], atol=0.02)

    def chi_square(one: str, other: str) -> float:
        a, b = expected[one], expected[other]
        return float(np.sum((a - b) ** 2 / np.maximum(a + b, 1e-300)) / 2)

    within = np.median([chi_square(names[i], names[j]) for i, j in ((0, 1), (0, 2), (1, 2))])
    others = np.median([chi_square(one, other) for one in names[:3] for other in names[3:]])
    (row,) = re.findall(r"^egg +3 +(\S+) +(\S+)$", printed, re.MULTILINE)
    assert [float(x) for x in row] == pytest.approx([within, others], abs=2e-3)
    assert others > 3 * within


def test_pose_takes_all_classes_and_refuses_unknown_ones(
    root: Path,
    tmp_path: Path,
    drawn: list[Figure],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    arguments = ["--out", tmp_path / "pose.png", "--cache_dir", tmp_path / "cache", *SMALL]
    igps(monkeypatch, "figure", "pose", root, *arguments)
    assert re.search(r"^rod +1 +- +\d\.\d+$", capsys.readouterr().out, re.MULTILINE)
    assert len(drawn[0].axes[0].get_lines()) == 6
    with pytest.raises(SystemExit, match="1"):
        igps(monkeypatch, "figure", "pose", root, "--classes", "egg", "hat", *arguments)
    assert "no class hat. It has ball, egg, rod" in capsys.readouterr().err


def test_topology_measures_the_change_of_the_same_pairs(
    open_ring: Path,
    tmp_path: Path,
    drawn: list[Figure],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "topology.png"
    small = ["--n_eigenpairs", "30", "--resolution", "16"]
    igps(monkeypatch, "figure", "topology", open_ring, "--out", out, *small, "--json")
    told, printed = capsys.readouterr()
    before = load_mesh(open_ring)
    a, b = facing_vertices(before)
    after = weld(before, a, b)
    points = interior_samples(before, 16)
    distances = [pdist(embedding(mesh, points, 30)) for mesh in (before, after)]
    change = 100 * np.abs(distances[1] / distances[0] - 1)
    assert change.max() > 20  # once around the ring is no longer the only way
    assert f"welded at vertices {a} and {b}" in printed
    assert "genus 0 before, 1 after" in printed
    assert f"{len(points)} interior samples, {len(change)} pairs, 30 eigenpairs" in printed
    for limit in (3, 10, 14):
        (share,) = re.findall(rf"less than +{limit} %: (\S+) %", printed)
        assert float(share) == pytest.approx(100 * np.mean(change < limit), abs=0.2)
    (largest,) = re.findall(r"largest change: (\S+) %", printed)
    assert float(largest) == pytest.approx(change.max(), rel=0.01)
    stiffness, mass = laplacian(after)
    eigenvalues = scipy.linalg.eigvalsh(stiffness.toarray(), np.diag(mass))[1:4]
    (row,) = re.findall(r"eigenvalues after: (.*)$", printed, re.MULTILINE)
    assert [float(x) for x in row.split(", ")] == pytest.approx(eigenvalues, rel=1e-3)
    found = json.loads(told)
    assert (found["genus"], found["n_samples"]) == ([0, 1], len(points))
    shares = [np.mean(change < limit) for limit in (3, 10, 14)]
    assert [found["changed_below"][limit] for limit in ("0.03", "0.1", "0.14")] == pytest.approx(
        shares, abs=2e-3
    )
    assert found["largest_change"] == pytest.approx(change.max() / 100, rel=0.01)
    assert found["first_eigenvalues"][1] == pytest.approx(eigenvalues, rel=1e-6)

    left, middle, right = drawn[0].axes
    heights = [patch.get_height() for patch in left.patches]
    assert sum(heights) == pytest.approx(100)
    assert left.get_yscale() == "log"
    assert "(%)" in left.get_xlabel()
    tube, rest = (
        sum(len(part.get_paths()) for part in right.collections if _is_orange(part) == orange)
        for orange in (1, 0)
    )
    assert tube == TUBE_FACES
    assert rest > TUBE_FACES
    assert middle.get_title()
    assert imread(out).std() > 0.05


def _is_orange(part: Any) -> bool:
    red, _, blue = part.get_facecolor()[0, :3]
    return bool(red > 2 * blue)


def test_topology_welds_where_it_is_told(
    open_ring: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    arguments = [
        "figure",
        "topology",
        open_ring,
        "--out",
        tmp_path / "t.png",
        "--n_eigenpairs",
        "10",
    ]
    igps(monkeypatch, *arguments, "--weld", "3", "357")
    assert "welded at vertices 3 and 357" in capsys.readouterr().out
    bad = {("3",): "two vertices, got 1", ("3", "400"): "b: expected a vertex index from 0 to 361"}
    for weld_at, message in bad.items():
        with pytest.raises(SystemExit, match="1"):
            igps(monkeypatch, *arguments, "--weld", *weld_at)
        assert message in capsys.readouterr().err


def test_potential_is_least_in_the_middle(
    tmp_path: Path,
    drawn: list[Figure],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    body = trimesh.creation.icosphere(subdivisions=3)
    body.vertices = body.vertices * [0.7, 2, 1] + [5, 6, 7]
    path, out = tmp_path / "egg.off", tmp_path / "potential.png"
    body.export(path, digits=17)
    slices: list[tuple[Any, ...]] = []
    draw = paper.draw_potential_slice
    monkeypatch.setattr(
        paper, "draw_potential_slice", lambda *args: (slices.append(args), draw(*args))
    )
    igps(monkeypatch, "figure", "potential", path, "--out", out, "--n_eigenpairs", "40", "--json")
    told, printed = capsys.readouterr()
    (x, y), values, outline, centre, _ = slices[0]
    # The longest axis, y, is up and the next, z, to the right.
    np.testing.assert_allclose(np.abs(centre), [7, 6], atol=0.02)
    grid_x, grid_y = np.meshgrid(x - centre[0], y - centre[1], indexing="ij")
    ellipse = np.sqrt(grid_x**2 + (grid_y / 2) ** 2)
    inside = ~np.isnan(values)
    assert inside[ellipse < 0.97].all()
    assert not inside[ellipse > 1.01].any()
    assert np.linalg.norm((outline - centre) / [1, 2], axis=2) == pytest.approx(1, abs=0.02)
    mesh = load_mesh(path)
    exact = np.linalg.norm(
        embedding(mesh, np.array([[5.0, 6.0, 7.0], [5.0, 7.5, 7.0]]), 40), axis=1
    )
    (least,) = re.findall(r"potential (\S+) at the barycentroid", printed)
    assert float(least) == pytest.approx(exact[0], rel=0.01)
    assert json.loads(told)["least"] == pytest.approx(exact[0], rel=0.01)
    assert np.nanmin(values) == pytest.approx(exact[0], rel=0.01)
    j = int(np.argmin(np.abs(y - centre[1] - 1.5)))
    assert values[int(np.argmin(np.abs(x - centre[0]))), j] == pytest.approx(exact[1], rel=0.03)
    panel, bar = drawn[0].axes
    assert "potential" in bar.get_ylabel()
    assert "unit" in panel.get_xlabel()
    (star,) = [line for line in panel.get_lines() if line.get_marker() == "*"]
    np.testing.assert_allclose(star.get_xydata()[0], centre)
    assert imread(out).std() > 0.05


def test_upright_turns_without_mirroring() -> None:
    points = np.random.default_rng(0).normal(size=(200, 3)) * [1, 4, 2]
    turned = paper.upright(points)
    frame = np.linalg.lstsq(points, turned, rcond=None)[0]
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-9)
    assert np.linalg.det(frame) == pytest.approx(1)
    assert frame[1, 1] > 0.95  # the longest axis is up, and not upside down
    assert frame[2, 0] > 0.95
