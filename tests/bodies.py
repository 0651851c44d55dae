"""Surfaces as plain arrays, points in and around them, and functions on them."""

import igl
import numpy as np
import trimesh

from igps.signature.mean_value import extend

Mesh = tuple[np.ndarray, np.ndarray]


def bumpy_sphere(subdivisions, amplitude=0.3):
    """A closed, star-shaped, asymmetric surface."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    x, y, z = sphere.vertices.T
    radius = 1 + amplitude * np.sin(3 * x + 0.5) * np.cos(2 * y) + 0.2 * amplitude * z
    vertices = sphere.vertices * radius[:, None] * [1.0, 0.8, 1.3]
    return np.asarray(vertices), np.asarray(sphere.faces, np.int64)


def cube():
    box = trimesh.creation.box(extents=(2, 2, 2))
    return np.asarray(box.vertices, np.float64), np.asarray(box.faces, np.int64)


def torus(n_major, n_minor):
    shape = trimesh.creation.torus(1.0, 0.35, major_sections=n_major, minor_sections=n_minor)
    return np.asarray(shape.vertices, np.float64), np.asarray(shape.faces, np.int64)


def interior_points(mesh, n, seed=0):
    vertices, faces = mesh
    low = vertices.min(0)
    high = vertices.max(0)
    points = np.random.default_rng(seed).uniform(
        low,
        high,
        (8 * n, 3),
    )
    return points[igl.winding_number(vertices, faces, points) > 0.5][:n]


def exterior_points(mesh, n, seed=0):
    vertices, faces = mesh
    low = 2 * vertices.min(0)
    high = 2 * vertices.max(0)
    points = np.random.default_rng(seed).uniform(
        low,
        high,
        (8 * n, 3),
    )
    return points[igl.winding_number(vertices, faces, points) < 0.5][:n]


def smooth_functions(vertices):
    x, y, z = vertices.T
    functions = [
        np.sin(2 * x),
        np.cos(3 * y + x),
        x * y * z,
        np.exp(z),
        np.sin(5 * z) * x,
        x,
    ]
    return np.stack(functions, axis=1)


def mean_value_coordinates(vertices, faces, points):
    """(P, V) at points (P, 3): what extends the vertices' own functions, each 1 at one vertex."""
    return extend(vertices, faces, np.eye(len(vertices)), points)
