"""Meshes and data that several tests use."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from igps.geometry.mesh import Mesh, load_mesh

# The meshes are small: on two threads they are hardly faster, and many times slower where another process takes a core.
torch.set_num_threads(1)

SHARED = Path(__file__).parents[2] / "shared"


def as_mesh(surface: trimesh.Trimesh, name: str = "mesh") -> Mesh:
    return Mesh(np.asarray(surface.vertices), np.asarray(surface.faces), name=name)


@pytest.fixture(scope="session")
def sphere() -> Mesh:
    """The unit sphere with 2,562 vertices."""
    return as_mesh(trimesh.creation.icosphere(subdivisions=4), "sphere")


@pytest.fixture(scope="session")
def blob() -> Mesh:
    """A small smooth body without symmetry, 642 vertices: its eigenvalues are well apart."""
    surface = trimesh.creation.icosphere(subdivisions=3)
    x, y, z = surface.vertices.T
    radius = 1 + 0.25 * x + 0.2 * np.sin(2.3 * y + 0.4) + 0.15 * x * z
    surface.vertices *= radius[:, None] * [1.0, 0.8, 1.3]
    return as_mesh(surface, "blob")


@pytest.fixture(scope="session")
def homer() -> Mesh:
    path = SHARED / "data" / "homer.obj"
    if not path.is_file():
        pytest.skip("the Homer model is not distributed with the project (expected in ../shared/data)")
    return load_mesh(path)
