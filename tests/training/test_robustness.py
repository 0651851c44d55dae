"""`robustness`: its movements against distances worked out by hand, and what it says where there are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from training.studies.disturbances import DISTURBANCES
from training.studies.robustness import POSE, Robustness, robustness

from conftest import horseshoe
from igps.data.collation import collate
from igps.data.dataset import SignatureDataset
from igps.data.sources import Bodies, find_bodies
from igps.descriptors import descriptor
from igps.descriptors.interior import interior
from igps.descriptors.literature.d2 import D2
from igps.mesh.loading import load_mesh
from igps.nn.descriptor import Descriptor
from igps.signature.signature import SignatureConfig, compute_signature
from own_descriptors import Root, Same, root_area, write_egg

CONFIG = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=60)


def of(source: Path | list[Path] | Bodies, tmp_path: Path) -> SignatureDataset:
    return SignatureDataset(source, CONFIG, tmp_path / "cache")


def run(
    tmp_path: Path, meshes: list[Path], *chosen: Descriptor, **options: SignatureDataset
) -> Robustness:
    return robustness(of(meshes, tmp_path), chosen, n_workers=1, **options)


def test_movements_are_shares_of_the_distance_between_the_meshes(tmp_path: Path) -> None:
    meshes = [write_egg(tmp_path / f"{height}.off", height) for height in (1.0, 1.5, 3.0)]
    found = run(tmp_path, meshes, Root())
    size = np.array([root_area(path) for path in meshes])
    unit = np.median([size[1] - size[0], size[2] - size[0], size[2] - size[1]])
    assert found.units == {"root": pytest.approx(unit)}
    movements = found.movements["root"]
    assert list(movements) == list(DISTURBANCES)
    expected = {str(path): 6 * one / unit for path, one in zip(meshes, size, strict=True)}
    assert movements["scale"].distances == pytest.approx(expected, rel=1e-5)
    assert movements["scale"].mean == pytest.approx(np.mean(6 * size / unit), rel=1e-5)
    assert movements["motion"].mean == pytest.approx(0, abs=1e-5)
    half = [np.sqrt(DISTURBANCES["half"].apply(load_mesh(path)).area) for path in meshes]
    moved = [abs(one - other) / unit for one, other in zip(half, size, strict=True)]
    assert list(movements["half"].distances.values()) == pytest.approx(moved, rel=1e-3)
    assert movements["hole"].mean is None
    assert movements["hole"].distances == {}
    assert movements["hole"].notes == dict.fromkeys(map(str, meshes), "a hole has no area")
    assert movements["weld"].mean is None  # an egg has no gap
    written = found.as_dict()
    assert written["movements"]["root"]["hole"] == {
        "mean": None,
        "each": {},
        "notes": dict.fromkeys(map(str, meshes), "a hole has no area"),
    }
    assert written["disturbances"] == {name: one.description for name, one in DISTURBANCES.items()}


def test_gallery_tells_the_distance_between_classes(tmp_path: Path) -> None:
    heights = {"low": (1.0, 1.3), "high": (2.0, 2.4, 5.0)}
    size = {
        label: [
            root_area(write_egg(tmp_path / "gallery" / label / f"{x}.off", x, 2)) for x in several
        ]
        for label, several in heights.items()
    }
    mesh = write_egg(tmp_path / "one.off", 1.2)
    found = run(tmp_path, [mesh], Root(), gallery=of(tmp_path / "gallery", tmp_path))
    unit = np.median([abs(low - high) for low in size["low"] for high in size["high"]])
    assert found.units["root"] == pytest.approx(unit, rel=1e-4)
    assert found.movements["root"]["scale"].mean == pytest.approx(
        6 * root_area(mesh) / unit, rel=1e-4
    )


def test_poses_are_compared_within_each_body(tmp_path: Path) -> None:
    meshes = [write_egg(tmp_path / f"{height}.off", height, 2) for height in (1.0, 2.0)]
    unit = root_area(meshes[1]) - root_area(meshes[0])
    poses = [write_egg(tmp_path / "poses" / f"{x}.off", x, 2) for x in (1.0, 1.1, 1.3)]
    size = [root_area(path) for path in poses]
    files = find_bodies(tmp_path / "poses")
    one_body = Bodies(files.paths, files.names, ("body",) * 3)
    movement = run(tmp_path, meshes, Root(), poses=of(one_body, tmp_path)).movements["root"][POSE]
    expected = {
        "1.0.off - 1.1.off": (size[1] - size[0]) / unit,
        "1.0.off - 1.3.off": (size[2] - size[0]) / unit,
        "1.1.off - 1.3.off": (size[2] - size[1]) / unit,
    }
    assert movement.distances == pytest.approx(expected, rel=1e-3)

    for name in ("a/1.off", "b/1.off", "b/2.off"):  # now two bodies, one of them in two poses
        write_egg(tmp_path / "bodies" / name, 1 + 0.2 * len(name), 2)
    movement = run(tmp_path, meshes, Root(), poses=of(tmp_path / "bodies", tmp_path)).movements[
        "root"
    ][POSE]
    assert list(movement.distances) == ["b/1.off - b/2.off"]


def test_no_distance_between_classes_leaves_no_movement(tmp_path: Path) -> None:
    meshes = [write_egg(tmp_path / name, 1.0) for name in ("a.off", "b.off", "nan.off")]
    found = run(tmp_path, meshes, Same())
    assert np.isnan(found.units["same"]) or found.units["same"] == 0
    assert found.as_dict()["median_between_classes"] == {"same": None}
    notes = found.movements["same"]["scale"].notes
    assert "no distance between classes" in notes[str(meshes[0])]
    assert "not finite" in notes[str(meshes[2])]
    assert all(movement.mean is None for movement in found.movements["same"].values())


def test_real_descriptors_on_a_body_with_a_gap(tmp_path: Path) -> None:
    paths = [write_egg(tmp_path / "egg.off", 2.0), tmp_path / "ring.off"]
    ring = horseshoe(0.06)
    trimesh.Trimesh(ring.vertices, ring.faces, process=False).export(paths[1])
    chosen = [interior(n_eigenpairs=20), D2()]
    found = run(tmp_path, paths, *chosen)
    for name in ("interior", "d2"):
        assert found.movements[name]["scale"].mean is not None
        assert found.movements[name]["scale"].mean < 1e-3
        assert set(found.movements[name]["hole"].distances) == set(map(str, paths))
        assert set(found.movements[name]["weld"].distances) == {str(paths[1])}
    # The weld makes the ring whole, which distances along the body notice and straight ones do not.
    welds = [found.movements[name]["weld"].mean or 0 for name in ("interior", "d2")]
    assert welds[0] > 2 * welds[1]
    # What was moved, by the library's parts: the disturbed ring described anew.
    meshes = [load_mesh(path) for path in paths]
    for way in ("weld", "noise", "half"):
        disturbed = DISTURBANCES[way].apply(meshes[1])
        batches = [collate([compute_signature(one, CONFIG)]) for one in (*meshes, disturbed)]
        for one in chosen:
            with torch.inference_mode():
                egg, whole, after = (one(batch) for batch in batches)
            expected = float(one.distances(whole, after) / one.distances(egg, whole))
            assert expected > 1e-3
            assert found.movements[one.name][way].distances[str(paths[1])] == pytest.approx(
                expected, rel=0.02
            )


def test_too_little_is_refused(tmp_path: Path) -> None:
    meshes = [write_egg(tmp_path / name, 1.5, 2) for name in ("a.off", "b.off")]
    with pytest.raises(ValueError, match=r"dataset: expected at least two meshes, .* or a gallery"):
        run(tmp_path, meshes[:1], Root())
    with pytest.raises(
        ValueError, match="descriptors: expected different names, got root more than once"
    ):
        run(tmp_path, meshes, Root(), Root())
    with pytest.raises(
        ValueError, match="n_eigenpairs: this descriptor needs signatures of at least 250, got 20"
    ):
        run(tmp_path, meshes, descriptor("interior"))
