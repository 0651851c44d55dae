"""The curvature and the thickness that explanations compare are those of closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from conftest import as_mesh
from igps.analysis.correspondence import local_shape
from igps.data.collation import collate
from igps.signature.signature import Signature, SignatureConfig, compute_signature

RADIUS, HALF_LENGTH = 1.0, 1.6


@pytest.fixture(scope="module", params=[(), ("surface_direction",)], ids=["estimated normals", "given normals"])
def spheroid(request: pytest.FixtureRequest) -> Signature:
    """Return the signature of a spheroid along the z axis."""
    body = trimesh.creation.icosphere(subdivisions=4)
    body.vertices *= [RADIUS, RADIUS, HALF_LENGTH]
    return compute_signature(as_mesh(body), SignatureConfig(n_eigenpairs=10, resolution=16, attributes=request.param))


def test_curvature_and_thickness_of_a_spheroid(spheroid: Signature) -> None:
    """A ball inside that touches at a point is centred on the axis, where the normal meets it."""
    curvature, thickness = local_shape(collate([spheroid])).T
    x, y, z = spheroid.surface.points.T
    slant = np.sqrt((x**2 + y**2) / RADIUS**4 + z**2 / HALF_LENGTH**4)
    of_circles, of_meridians = 1 / (RADIUS**2 * slant), 1 / (RADIUS**2 * HALF_LENGTH**2 * slant**3)
    unit = np.sqrt(spheroid.area)
    assert curvature == pytest.approx(0.08 * unit * (of_circles + of_meridians) / 2, rel=0.1)
    assert np.exp(thickness) * unit * of_circles == pytest.approx(1, rel=0.25)  # normals of flat faces


def test_a_rough_surface_is_no_thinner(spheroid: Signature) -> None:
    """Neighbours a little below the tangent plane make no ball small."""
    step = 0.001 * np.sqrt(spheroid.area) * np.random.default_rng(0).normal(size=spheroid.surface.points.shape)
    rough = replace(spheroid, surface=replace(spheroid.surface, points=spheroid.surface.points + step))
    thickness = [local_shape(collate([body]))[:, 1] for body in (spheroid, rough)]
    assert thickness[1] == pytest.approx(thickness[0], abs=0.6)
