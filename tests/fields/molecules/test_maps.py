"""Density maps become bodies where they lie, against balls and boxes in closed form."""

import gzip

import numpy as np
import pytest
from numpy.linalg import norm

from igps.mesh.errors import MeshError
from igps.mesh.loading import load_mesh
from igps.mesh.options import LoadOptions

mrcfile = pytest.importorskip("mrcfile")

SIDES = np.array([0.5, 0.6, 0.8])
SHAPE = (40, 36, 30)
START = np.array([-12, 5, 30])
CENTRE = (START + np.array([19.3, 17.6, 14.2])) * SIDES


def points():
    return (np.stack(np.indices(SHAPE), axis=-1) + START) * SIDES


def write(path, values, order=(1, 2, 3), told="start"):
    """Write values (X, Y, Z) with columns, rows and sections along the axes (1 to 3) in `order`."""
    columns, rows, sections = (axis - 1 for axis in order)
    with mrcfile.new(path) as file:
        file.set_data(
            np.ascontiguousarray(
                values.transpose(sections, rows, columns),
                np.float32,
            )
        )
        header = file.header
        header.mx, header.my, header.mz = values.shape
        header.cella = tuple(SIDES * values.shape)
        header.mapc, header.mapr, header.maps = order
        if told == "start":
            header.nxstart, header.nystart, header.nzstart = START[[columns, rows, sections]]
        else:
            header.origin = tuple(START * SIDES)
    return path


def ball(radius=6.0):
    return radius - norm(points() - CENTRE, axis=-1)


@pytest.mark.parametrize("told", ["start", "origin"])
@pytest.mark.parametrize(
    "order",
    [(1, 2, 3), (3, 1, 2), (2, 1, 3)],
)
def test_a_ball_lies_where_the_header_says_whatever_the_order_of_axes(order, told, tmp_path):
    path = write(tmp_path / "ball.mrc", ball(), order, told)
    mesh = load_mesh(path, LoadOptions(threshold=0.5))
    away = norm(mesh.vertices - CENTRE, axis=1)
    np.testing.assert_allclose(away, 5.5, atol=0.05)
    expected = pytest.approx(
        4 / 3 * np.pi * 5.5**3,
        rel=0.01,
    )
    assert mesh.volume == expected
    assert mesh.area == pytest.approx(4 * np.pi * 5.5**2, rel=0.01)
    assert mesh.unit == "Å"
    assert mesh.genus == 0
    assert "density of at least 0.5" in mesh.notes


@pytest.mark.parametrize("suffix", [".map", ".ccp4", ".mrc.gz"])
def test_all_suffixes_are_read_packed_or_not(suffix, tmp_path):
    plain = write(tmp_path / "ball.mrc", ball())
    path = tmp_path / f"other{suffix}"
    content = plain.read_bytes()
    path.write_bytes(gzip.compress(content) if suffix.endswith(".gz") else content)
    options = LoadOptions(threshold=0.0)
    np.testing.assert_array_equal(
        load_mesh(path, options).vertices, load_mesh(plain, options).vertices
    )


def test_a_box_at_the_border_is_closed_there(tmp_path):
    values = np.zeros(SHAPE)
    values[:20, 10:22, 5:25] = 1
    mesh = load_mesh(write(tmp_path / "box.mrc", values), LoadOptions(threshold=0.5))
    expected = pytest.approx(
        20 * 12 * 20 * SIDES.prod(),
        rel=0.02,
    )
    assert mesh.volume == expected
    assert "at the border of the map: closed there" in mesh.notes
    low = (START + np.array([-0.5, 9.5, 4.5])) * SIDES
    np.testing.assert_allclose(mesh.vertices.min(axis=0), low, atol=0.02)


def test_dust_is_left_out_and_hollows_are_filled_with_notes(tmp_path):
    values = np.minimum(
        ball(),
        norm(points() - CENTRE, axis=-1) - 2.0,
    )
    values[2, 2, 2] = values[37, 3, 3] = 1.0
    mesh = load_mesh(write(tmp_path / "shell.mrc", values), LoadOptions(threshold=0.0))
    expected = pytest.approx(
        4 / 3 * np.pi * 6**3,
        rel=0.01,
    )
    assert mesh.volume == expected
    assert "1 hollow inside: filled" in mesh.notes
    assert any(note.startswith("left out 2 small pieces, 0.") for note in mesh.notes)


def test_a_map_without_a_threshold_is_refused_with_its_values(tmp_path):
    path = write(tmp_path / "ball.mrc", ball())
    said = r"ball\.mrc: expected a threshold.*Values go from -\S+ to 5\.\d+;.*--threshold.*EMDB"
    with pytest.raises(MeshError, match=said):
        load_mesh(path)
    with pytest.raises(MeshError, match="no value is at least the threshold, 9"):
        load_mesh(path, LoadOptions(threshold=9))
    with pytest.raises(MeshError, match="all values are at least the threshold, -99"):
        load_mesh(path, LoadOptions(threshold=-99))


@pytest.mark.parametrize("suffix", ["mrc", "mrc.gz"])
def test_a_header_that_claims_more_than_there_is_takes_no_memory(suffix, tmp_path):
    content = bytearray(write(tmp_path / "ball.mrc", ball()).read_bytes())
    content[:12] = np.array([1000, 1000, 1500], "<i4").tobytes()
    path = tmp_path / f"large.{suffix}"
    path.write_bytes(gzip.compress(bytes(content)) if suffix.endswith("gz") else content)
    with pytest.raises(MeshError, match=r"large\.mrc.*(expected 6000001024|memory)"):
        load_mesh(path, LoadOptions(threshold=0.0))
