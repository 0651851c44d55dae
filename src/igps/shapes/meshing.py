"""From a posed body to a triangle mesh: blending, marching cubes, relaxation, surface noise, and the final check."""

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from igps._arrays import Floats, Integers
from igps.mesh import surface
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.shapes.skeleton import Placed

_MIN_ANGLE = 5.0  # degrees; keeps every cotangent below 11.5
_VERTEX_TOLERANCE = 0.4  # as a share of the requested number
_COARSE_CELLS = 30_000  # of the grid that estimates the surface area
_SNAP = 0.1  # share of the spacing to which smaller absolute grid values are raised
_RELAXATION_STEPS = 10


def mesh(body: Sequence[Placed], target: int) -> tuple[Floats, Integers, float]:
    """Return about ``target`` vertices (V,3), within a tenth, outward faces (F,3), and the grid spacing."""
    from skimage.measure import marching_cubes

    # Vertices are crossings of the surface with grid lines: on average 1.5 of them in an area of spacing².
    spacing = float(np.sqrt(1.5 * _rough_area(body) / target))
    for _ in range(3):
        low, grid = _sample(body, spacing)
        # Keep vertices away from grid points: otherwise they may coincide, and faces degenerate.
        least = _SNAP * spacing
        snapped = np.where(grid < 0.0, -least, least)
        grid = np.where(np.abs(grid) < least, snapped, grid)
        points, faces, _, _ = marching_cubes(grid, 0.0, gradient_direction="descent")
        ratio = len(points) / target
        if abs(ratio - 1.0) < 0.1:
            break
        spacing *= float(np.sqrt(ratio))
    vertices = low + spacing * points.astype(np.float64)
    faces = faces.astype(np.int64)
    return _relax(body, vertices, faces, spacing), faces, spacing


def roughen(
    vertices: Floats, faces: Integers, amplitude: float, wavelength: float, rng: np.random.Generator
) -> Floats:
    """Move vertices (V,3) along their normals by random waves; ``amplitude`` is the standard deviation."""
    frequency = 2.0 * np.pi / wavelength
    waves = rng.normal(size=(12, 3)) * (frequency / np.sqrt(3.0))
    phases = rng.uniform(0.0, 2.0 * np.pi, 12)
    noise = np.zeros(len(vertices))
    x, y, z = vertices.T
    for (a, b, c), phase in zip(waves, phases, strict=True):
        noise += np.sin(x * a + y * b + z * c + phase)
    # The sum of twelve waves has the standard deviation √6.
    heights = amplitude * noise / np.sqrt(6.0)
    normals = surface.vertex_normals(vertices, faces)
    return vertices + normals * heights[:, None]


def defect(
    vertices: Floats, faces: Integers, genus: int, n_vertices: int, min_angle: float = _MIN_ANGLE
) -> str | None:
    """Return what makes a mesh unfit for the benchmark, in words, or None; ``min_angle`` in degrees."""
    import igl

    ratio = len(vertices) / n_vertices
    if abs(ratio - 1.0) > _VERTEX_TOLERANCE:
        return f"{len(vertices)} vertices"
    try:
        body = Mesh(vertices, faces)
    except MeshError as error:
        return str(error)
    if body.genus != genus:
        return f"genus {body.genus}, expected {genus}"
    if body.notes:
        return "inside out"
    angles = igl.internal_angles(vertices, faces)
    angle = float(np.degrees(angles.min()))
    if not angle >= min_angle:  # NaN if corners coincide or are collinear
        return f"a triangle with an angle of {angle:.2g} degrees"
    return None


def _distance(body: Sequence[Placed], points: Floats) -> Floats:
    """Return the blended signed distance (V,) at points (V,3)."""
    x, y, z = points.T
    total = body[0].distance(x, y, z)
    for part in body[1:]:
        distance = part.distance(x, y, z)
        total = _smooth_minimum(total, distance, part.blend)
    return total


def _smooth_minimum(a: Floats, b: Floats, blend: float) -> Floats:
    """Return the polynomial smooth union of two distances, their minimum unless they differ by less than ``blend``."""
    overlap = np.maximum(blend - np.abs(a - b), 0.0)
    depth = overlap * overlap / (4.0 * blend)
    return np.minimum(a, b) - depth


def _bounds(body: Sequence[Placed]) -> tuple[Floats, Floats]:
    boxes = [part.bounds() for part in body]
    lows, highs = zip(*boxes, strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def _sample(body: Sequence[Placed], spacing: float) -> tuple[Floats, Floats]:
    """Return the first corner (3,) of a grid, and the blended distances on it; solids are evaluated only nearby."""
    margin = max(part.blend for part in body) + 2.5 * spacing
    low, high = _bounds(body)
    low = low - margin
    size = high + margin - low
    n_steps = np.ceil(size / spacing)
    shape = n_steps.astype(int) + 1
    axes = [start + spacing * np.arange(n) for start, n in zip(low, shape, strict=True)]
    x, y, z = axes
    grid = np.full(shape, 1e3)  # far outside
    for part in body:
        first, last = part.bounds()
        first_step = np.floor((first - margin - low) / spacing)
        last_step = np.ceil((last + margin - low) / spacing)
        start = np.maximum(first_step.astype(int), 0)
        stop = np.minimum(last_step.astype(int) + 1, shape)
        i, j, k = map(slice, start, stop)
        window = (i, j, k)
        distance = part.distance(*np.ix_(x[i], y[j], z[k]))
        grid[window] = _smooth_minimum(grid[window], distance, part.blend)
    return low, grid


def _rough_area(body: Sequence[Placed]) -> float:
    """Estimate the surface area from the volume of a band that reaches one coarse cell to both sides of the surface."""
    low, high = _bounds(body)
    volume = float(np.prod(high - low))
    spacing = (volume / _COARSE_CELLS) ** (1.0 / 3.0)
    _, grid = _sample(body, spacing)
    is_near = np.abs(grid) < spacing
    n_near = float(np.count_nonzero(is_near))
    return n_near * spacing**2 / 2.0


def _relax(body: Sequence[Placed], vertices: Floats, faces: Integers, spacing: float) -> Floats:
    """Slide vertices (V,3) towards their neighbours' mean along the surface, and back onto the zero level set."""
    start, end = surface.directed_edges(faces)
    n = len(vertices)
    ones = np.ones(len(start))
    adjacency = sparse.csr_array((ones, (start, end)), shape=(n, n))
    degree = np.bincount(start, minlength=n)[:, None]
    for _ in range(_RELAXATION_STEPS):
        normals = surface.vertex_normals(vertices, faces)
        mean = (adjacency @ vertices) / degree
        step = mean - vertices
        along_normal = (step * normals).sum(axis=1, keepdims=True)
        step -= normals * along_normal
        vertices = vertices + 0.7 * step
        heights = _distance(body, vertices)
        heights = np.clip(heights, -0.5 * spacing, 0.5 * spacing)
        vertices -= normals * heights[:, None]
    return vertices
