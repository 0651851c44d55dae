"""Stiffness and mass of surfaces, without the library under test."""

import numpy as np
import trimesh
from scipy import sparse


def cotangent_problem(mesh):
    """Cotangent stiffness, barycentric mass and positions, written without regard to speed."""
    corners = np.asarray(mesh.vertices)[mesh.faces]
    n_vertices = len(mesh.vertices)
    stiffness = sparse.csr_array((n_vertices, n_vertices))
    for corner in range(3):
        one = (corner + 1) % 3
        two = (corner + 2) % 3
        a = corners[:, one] - corners[:, corner]
        b = corners[:, two] - corners[:, corner]
        weight = 0.5 * (a * b).sum(1) / np.linalg.norm(np.cross(a, b), axis=1)
        i = mesh.faces[:, one]
        j = mesh.faces[:, two]
        entries = np.r_[weight, weight, -weight, -weight], (np.r_[i, j, i, j], np.r_[i, j, j, i])
        stiffness = stiffness + sparse.csr_array(
            sparse.coo_array(entries, shape=(n_vertices, n_vertices))
        )
    mass = np.bincount(
        mesh.faces.ravel(),
        np.repeat(mesh.area_faces / 3, 3),
        n_vertices,
    )
    return stiffness, mass, np.array(mesh.vertices)


def torus(n_major=48, n_minor=24, jitter=0.2):
    mesh = trimesh.creation.torus(1.0, 0.4, major_sections=n_major, minor_sections=n_minor)
    mesh.vertices += (
        np.random.default_rng(0).uniform(-jitter, jitter, mesh.vertices.shape) / n_minor
    )
    return mesh
