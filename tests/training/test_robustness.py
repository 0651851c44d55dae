"""Movements of descriptions, against distances worked out by hand."""

import numpy as np
import pytest
import torch
import trimesh
from docs.benchmarks.robustness import (
    DISTURBANCES,
    describe_disturbed,
    median_between_classes,
    movements,
    robustness,
)

from conftest import horseshoe
from igps.data.collation import collate
from igps.descriptors.interior import interior
from igps.descriptors.literature.d2 import D2
from igps.mesh.loading import load_mesh
from igps.signature.signature import SignatureConfig, compute_signature
from own_descriptors import Root, root_area, write_egg

ROOT = "own_descriptors:Root"


def test_the_table_holds_mean_movements_over_the_distance_between_classes(tmp_path, capsys):
    def sizes_in(folder, heights):
        return [
            root_area(
                write_egg(
                    tmp_path / folder / f"{x}.off",
                    x,
                    2,
                )
            )
            for x in heights
        ]

    meshes = [
        write_egg(
            tmp_path / f"{height}.off",
            height,
        )
        for height in (1.0, 3.0)
    ]
    low = sizes_in("gallery/low", (1.0, 1.3))
    high = sizes_in("gallery/high", (2.0, 2.4))
    poses = sizes_in("poses", (1.0, 1.1, 1.3))
    robustness(meshes, tmp_path / "gallery", tmp_path / "poses", [ROOT], tmp_path / "cache", 1)
    header, row, *rest = capsys.readouterr().out.splitlines()
    assert header.split() == [*DISTURBANCES, "pose"]
    name, *cells = row.split()
    found = dict(
        zip(
            header.split(),
            map(float, cells),
            strict=True,
        )
    )

    unit = np.median(np.subtract.outer(high, low))
    sizes = [root_area(mesh) for mesh in meshes]
    assert name == "root"
    expected = pytest.approx(
        100 * 6 * np.mean(sizes) / unit,
        rel=1e-3,
    )
    assert found["scale"] == expected
    assert found["motion"] == pytest.approx(0, abs=0.1)
    between_poses = [
        poses[1] - poses[0],
        poses[2] - poses[0],
        poses[2] - poses[1],
    ]
    expected = pytest.approx(
        100 * np.mean(between_poses) / unit,
        rel=1e-2,
    )
    assert found["pose"] == expected
    halves = [np.sqrt(DISTURBANCES["half"].apply(load_mesh(path)).area) for path in meshes]
    moved = np.mean(np.abs(np.subtract(halves, sizes)))
    assert found["half"] == pytest.approx(100 * moved / unit, rel=0.02, abs=0.1)
    # A hole has no area, and an egg has no gap to weld.
    assert np.isnan(found["hole"])
    assert np.isnan(found["weld"])
    assert "root, hole: 2 missing; a hole has no area" in rest
    assert any(line.startswith("root, weld: 2 missing; ") for line in rest)
    for column, disturbance in DISTURBANCES.items():
        assert f"  {column}: {disturbance.description}" in rest


def test_real_descriptors_on_a_body_with_a_gap(tmp_path):
    ring = horseshoe(0.06)
    path = tmp_path / "ring.off"
    trimesh.Trimesh(ring.vertices, ring.faces, process=False).export(path)
    along, straight = chosen = [interior(n_eigenpairs=20), D2()]
    (answers,) = describe_disturbed([path], chosen, n_workers=1)

    def movement(descriptor, column):
        ((found,), _) = movements(
            descriptor,
            [answers[descriptor.name]],
            column,
        )
        return found

    # The weld makes the ring whole, which distances along the body notice and straight ones do not.
    assert movement(along, "weld") > 2 * movement(straight, "weld")
    assert movement(along, "scale") < 1e-3
    mesh = load_mesh(path)
    config = chosen[0].requirements | chosen[1].requirements
    for column in ("weld", "noise", "half"):
        disturbed = DISTURBANCES[column].apply(mesh)
        batches = []
        for body in (mesh, disturbed):
            signature = compute_signature(body, config.apply_to(SignatureConfig()))
            batches.append(collate([signature], [body]))
        for descriptor in chosen:
            with torch.inference_mode():
                before, after = (descriptor(batch) for batch in batches)
                expected = float(descriptor.distances(before, after))
            assert expected > 1e-4
            assert movement(descriptor, column) == pytest.approx(expected, rel=0.02)


def test_a_gallery_of_one_class_is_refused(tmp_path):
    for height in (1.0, 2.0):
        write_egg(tmp_path / f"gallery/one/{height}.off", height, 2)
    with pytest.raises(ValueError, match=r"gallery: expected two classes in .*, got one"):
        median_between_classes(tmp_path / "gallery", Root(), tmp_path / "cache", 1)
