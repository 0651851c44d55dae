"""The curvature and the thickness that explanations compare are those of closed forms."""

import numpy as np
import pytest
import trimesh

from conftest import as_mesh
from igps.analysis.correspondence import local_shape
from igps.data.collation import collate
from igps.signature.signature import SignatureConfig, compute_signature


def test_curvature_and_thickness_of_a_spheroid() -> None:
    """A ball inside that touches at a point is centred on the axis, where the normal meets it."""
    radius, half_length = 1.0, 1.6
    body = trimesh.creation.icosphere(subdivisions=4)
    body.vertices *= [radius, radius, half_length]
    signature = compute_signature(as_mesh(body), SignatureConfig(n_eigenpairs=10, resolution=16))
    curvature, thickness = local_shape(collate([signature])).T
    x, y, z = signature.surface.points.T
    slant = np.sqrt((x**2 + y**2) / radius**4 + z**2 / half_length**4)
    of_circles, of_meridians = 1 / (radius**2 * slant), 1 / (radius**2 * half_length**2 * slant**3)
    unit = np.sqrt(signature.area)
    assert curvature == pytest.approx(0.08 * unit * (of_circles + of_meridians) / 2, rel=0.1)
    assert np.exp(thickness) * unit * of_circles == pytest.approx(1, rel=0.1)
