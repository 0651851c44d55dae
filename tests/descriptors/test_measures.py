"""Plain numbers as a descriptor, from files to distances."""

import math
from dataclasses import replace

import pytest
import torch
import trimesh

import igps
from igps.data.collation import collate
from igps.descriptors.measures import Measures
from igps.mesh.mesh import Mesh
from igps.signature.signature import SignatureConfig, compute_signature

SPHERE = trimesh.creation.icosphere(subdivisions=3)
CONFIG = SignatureConfig(n_eigenpairs=0, measures=True)


def ellipsoid(*semi_axes, unit=None):
    return Mesh(SPHERE.vertices * semi_axes, SPHERE.faces, unit=unit)


def test_signatures_of_files_hold_the_numbers_of_their_meshes(tmp_path):
    for height in (1, 2):
        tall = trimesh.Trimesh(
            SPHERE.vertices * [1, 1, height],
            SPHERE.faces,
        )
        tall.export(tmp_path / f"{height}.off")
    described = igps.SignatureDataset(tmp_path, descriptor=Measures(), cache_dir=tmp_path / "cache")
    assert described.precompute(progress=False, n_workers=1) == []
    assert described.config.n_eigenpairs == 0
    first, second = described.measures()
    assert second["volume"] / first["volume"] == pytest.approx(2)
    assert dict(described[1].signature.measures) == dict(second)
    assert len(described[1].signature.eigenvalues) == 0


def test_scaled_bodies_differ_by_their_size_alone():
    bodies = [
        ellipsoid(1, 2, 3),
        ellipsoid(2, 4, 6),
        ellipsoid(1, 1, 3),
    ]
    bodies.append(ellipsoid(0.1, 0.2, 0.3, unit="cm"))
    batch = collate([compute_signature(body, CONFIG) for body in bodies])
    found = igps.descriptor("measures")
    first = found(batch)
    same, other, in_centimetres = found.distances(first[:1], first[1:])[0].tolist()
    assert max(same, in_centimetres) < 1e-3 < 0.1 < other
    sized = igps.descriptor("measures", size="keep")
    assert sized.name == "measures+size"
    logarithms = sized(batch) * sized.spread
    without_unit = ("extent", "convexity", "n_pieces", "euler_number")
    has_unit = torch.tensor([name not in without_unit for name in sized.columns])
    doubled = (logarithms[1] - logarithms[0])[has_unit]
    torch.testing.assert_close(doubled, torch.full_like(doubled, math.log(2)), atol=1e-3, rtol=0)
    torch.testing.assert_close(
        logarithms[3],
        logarithms[0],
        atol=1e-3,
        rtol=0,
    )


def test_bodies_without_numbers_are_refused():
    bare = replace(
        compute_signature(ellipsoid(1, 2, 3), CONFIG),
        measures={},
    )
    with pytest.raises(ValueError, match=r"^measures: expected bodies with plain numbers"):
        igps.descriptor("measures")(collate([bare]))


def test_columns_are_scaled_by_the_first_collection_and_by_no_other():
    bodies = [ellipsoid(1, 2, height) for height in (1, 2, 4)]
    numbers = [compute_signature(body, CONFIG).measures for body in bodies]
    found = Measures()
    assert found.fit_collection(numbers, [None] * 3)
    batch = collate([compute_signature(body, CONFIG) for body in bodies])
    spread = found(batch).std(dim=0)
    column = found.columns.index("major_axis_length")
    assert float(spread[column]) == pytest.approx(1, rel=1e-4)
    before = found.spread.clone()
    assert not found.fit_collection(numbers[:2], [None] * 2)
    assert torch.equal(found.spread, before)
