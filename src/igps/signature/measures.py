"""Plain numbers of a body by the names of radiomics: sizes, axes, thickness, curvature, pieces.

Names and definitions are those of the Image Biomarker Standardisation Initiative (IBSI, Zwanenburg et al. 2020), as
PyRadiomics prints them, where these have the number. All are computed from the surface and not from voxel centres:
volume, moments and curvature are exact integrals over the mesh.
"""

import math
from collections.abc import Mapping

import numpy as np
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.distance import cdist

from igps._arrays import Floats, Integers
from igps._threads import one_thread
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.surface import (
    TINY,
    area_vectors,
    components,
    directed_edges,
    dots,
    undirected_edges,
)
from igps.signature.config import SignatureConfig
from igps.signature.voxels import interior_samples

MEASURES_VERSION = 8
"""Part of the cache keys of plain numbers: raise it whenever the same mesh would give other numbers."""

POWERS: Mapping[str, int] = {
    "voxel_volume": 3,
    "volume": 3,
    "area": 2,
    "surface_volume_ratio": -1,
    "sphericity": 0,
    "major_axis_length": 1,
    "minor_axis_length": 1,
    "least_axis_length": 1,
    "elongation": 0,
    "flatness": 0,
    "largest_diameter": 1,
    "mean_thickness": 1,
    "greatest_thickness": 1,
    "extent": 0,
    "convexity": 0,
    "n_pieces": 0,
    "euler_number": 0,
    "mean_curvature": -1,
    "total_curvature": 1,
    "centroid_x": 1,
    "centroid_y": 1,
    "centroid_z": 1,
    "spacing_x": 1,
    "spacing_y": 1,
    "spacing_z": 1,
}
"""The power of the unit of length of each measure, by its name."""

# Directions, evenly on a half sphere, along which widths are measured first: neighbours are 0.16 apart, so the largest
# of these widths is within 0.4 % of the largest diameter, which the steps after them find.
_N_DIRECTIONS = 250
_N_DIAMETER_STEPS = 3
_USUAL = SignatureConfig()
# Interior points at which the thickness is measured, and the largest number of steps by which balls grow there; most
# need eight. A step of less than a hundredth of the radius is the last.
_N_THICKNESS_POINTS = 400
_N_THICKNESS_STEPS = 16
_LAST_STEP = 0.01
_OPPOSITE = 0.05  # length of the sum of two unit vectors that are opposite to each other
_LEAST_GROWTH = 1e-6  # more than rounding
_LARGE = 0.9  # share of the largest radius from which a ball turns between two walls
# Samples of the surface in which nearest points are looked for, over area³/volume², and their largest number: their
# spacing is about a third of the thickness of a plate.
_SAMPLES_PER_THICKNESS = 8
_MAX_SAMPLES = 50_000
_N_NEAREST = 4


@one_thread()
def measures(mesh: Mesh, points: Floats | None = None) -> dict[str, float]:
    """Return the plain numbers of a body by name, in the order of `POWERS` and in the mesh's unit of length.

    Lengths, areas and volumes have the unit to the power of `POWERS`. Example of a ball of radius 1:

    Example:
        >>> import trimesh
        >>> from igps.mesh.objects import as_mesh
        >>> ball = measures(as_mesh(trimesh.creation.icosphere(subdivisions=4)))
        >>> round(ball["sphericity"], 2), round(ball["mean_thickness"], 2)  # 1, and its diameter
        (1.0, 2.0)
        >>> ball["euler_number"]
        1.0

    - `voxel_volume` (IBSI YEKZ): number of voxels times their volume; only of bodies from voxels.
    - `volume` V (RNU0), `area` A (C0JK) of the surface, and `surface_volume_ratio` A/V (2PR5).
    - `sphericity` (QCFX): ∛(36 π V²)/A, 1 for a ball.
    - `major_axis_length` (TDIC), `minor_axis_length` (P9VJ), `least_axis_length` (7J51): 4 √λ, with the eigenvalues λ
      of the covariance of the points of the body; 4a/√5 for an ellipsoid with the semi-axis a.
    - `elongation` (Q3CK), `flatness` (N17B): the second and the third axis over the first.
    - `largest_diameter` (L0JK): the largest distance of two points of the surface.
    - `mean_thickness`, `greatest_thickness`: of the diameters of the largest balls in the body that contain each of its
      points (Hildebrand and Rüegsegger 1997).
    - `extent`: volume over that of the box along the principal axes.
    - `convexity` (R3ER): volume over that of the convex hull.
    - `n_pieces`: pieces that share no corner, before small ones were dropped; of a body from voxels, of its voxels.
    - `euler_number`: pieces minus tunnels plus cavities; of a body from voxels, of its voxels.
    - `centroid_x`, `centroid_y`, `centroid_z`: centre of the volume, in the coordinates of the file; of volumes in RAS.
    - `spacing_x`, `spacing_y`, `spacing_z`: sides of a voxel, along the axes of the image next to x, y and z.
    - `total_curvature`: the integral of the mean curvature M, half the sum over edges of length times angle (Steiner
      1840); 4πr for a ball. `mean_curvature`: M/A.

    Args:
        mesh: the body.
        points: (P, 3) its `interior_samples` by the default configuration, if known; found if None.

    Raises:
        MeshError: no points were found inside the body.
    """
    mesh = mesh.numbered_by_faces()  # rounding depends on the numbering
    if points is None:
        points = interior_samples(mesh, _USUAL.resolution, _USUAL.min_samples)
    volume = mesh.volume
    area = mesh.area
    hull = ConvexHull(mesh.vertices)
    corners = mesh.vertices[hull.vertices]
    centroid, variances, axes = _moments(mesh)
    least, minor, major = 4 * np.sqrt(variances)
    box = np.ptp(corners @ axes, axis=0).prod()
    thickness = local_thickness(mesh, points)
    edges, edge_of = undirected_edges(mesh.faces)
    total_curvature = _total_mean_curvature(mesh, edge_of)
    numbers = {
        "volume": volume,
        "area": area,
        "surface_volume_ratio": area / volume,
        "sphericity": np.cbrt(36 * np.pi * volume**2) / area,
        "major_axis_length": major,
        "minor_axis_length": minor,
        "least_axis_length": least,
        "elongation": minor / major,
        "flatness": least / major,
        "largest_diameter": _diameter(corners),
        "mean_thickness": thickness.mean(),
        "greatest_thickness": thickness.max(),
        "extent": volume / box,
        "convexity": volume / hull.volume,
        "n_pieces": 1,
        "euler_number": _euler_number(mesh, edges, edge_of),
        "mean_curvature": total_curvature / area,
        "total_curvature": total_curvature,
        "centroid_x": centroid[0],
        "centroid_y": centroid[1],
        "centroid_z": centroid[2],
        **mesh.given,
    }
    known = [name for name in POWERS if name in numbers]
    return {name: float(numbers[name]) for name in known}


def local_thickness(mesh: Mesh, points: Floats) -> Floats:
    """Return the diameters (≤ P,) of the largest balls inside the mesh that contain points (P, 3) inside, length.

    Of many points, an even selection is taken. From each, a ball grows towards the middle of the body: its centre moves
    away from the nearest point of the surface, for as long as the ball grows and contains the point. Where another wall
    comes near, a centre turns and moves on between both. The thickness at a point is the largest diameter of all such
    balls that contain it.
    """
    surface = _NearestPoints(mesh)
    points = _even_selection(points)
    depths, away = surface.depths(points)
    inside = depths > 0
    if not inside.any():
        raise MeshError(
            f"{mesh.name}: expected points inside the body, got none. Give it some thickness."
        )
    balls = _Balls(points[inside], depths[inside], away[inside])
    for _ in range(_N_THICKNESS_STEPS):
        balls.grow(surface, balls.unfinished())
    return balls.thickness()


class _Balls:
    """Balls in a body, each of which grows and keeps a point of its own inside."""

    def __init__(self, points: Floats, depths: Floats, away: Floats) -> None:
        self._points = points
        self._centres = points.copy()
        self._radii = depths
        self._away = away  # unit vectors, from the nearest point of the surface
        self._heading = away.copy()
        self._step = np.maximum(depths, depths.max() - depths)

    def unfinished(self) -> Integers:
        """Return the balls that may still grow: the largest, and those whose point is not in the largest."""
        largest = _first_largest(self._radii)
        distances = _lengths(self._points - self._centres[largest])
        in_largest = distances <= self._radii[largest]
        in_largest[largest] = False
        may_grow = self._step >= _LAST_STEP * self._radii
        return np.flatnonzero(may_grow & ~in_largest)

    def grow(self, surface: "_NearestPoints", balls: Integers) -> None:
        """Move the centres of some balls a step ahead where a larger ball is there; shorten other steps."""
        step = self._step[balls]
        centres = self._centres[balls] + step[:, None] * self._heading[balls]
        radii, away = surface.depths(centres)
        is_larger = radii > (1 + _LEAST_GROWTH) * self._radii[balls]
        contains_point = _lengths(centres - self._points[balls]) <= radii
        grows = is_larger & contains_point
        self._step[balls] = step / 2
        self._meet(balls[~is_larger], radii[~is_larger], away[~is_larger])
        grown = balls[grows]
        self._centres[grown] = centres[grows]
        self._radii[grown] = radii[grows]
        self._away[grown] = away[grows]
        self._heading[grown] = _unit(away[grows] + self._heading[grown] / 2)
        self._step[grown] = radii[grows] / 2

    def _meet(self, balls: Integers, radii: Floats, away: Floats) -> None:
        """Aim where the walls behind and ahead are equally near; from there, along both."""
        heading = self._heading[balls]
        step = self._step[balls]
        old_radii = self._radii[balls]
        slope = dots(self._away[balls], heading)
        slope_ahead = dots(away, heading)
        turn = np.maximum(slope - slope_ahead, 1e-9)
        level = (radii - old_radii - 2 * step * slope_ahead) / turn
        step = np.clip(level, 0, step)
        along = self._away[balls] + away
        turns = step < _LAST_STEP * old_radii
        turns &= old_radii > _LARGE * self._radii.max()
        turns &= _lengths(along) > _OPPOSITE
        step[turns] = old_radii[turns] / 2
        self._step[balls] = step
        self._heading[balls[turns]] = _unit(along[turns])

    def thickness(self) -> Floats:
        """Return the diameter (N,) of the largest of all balls that contain each point."""
        distances = cdist(self._points, self._centres)
        contains = distances <= self._radii * (1 + 1e-9)
        radii = np.where(contains, self._radii, 0)
        return 2 * radii.max(axis=1)


def _even_selection(points: Floats) -> Floats:
    """Return every n-th point by its distance from the middle, so that a turned grid gives the same selection."""
    as_on_grid = np.lexsort(points.T[::-1])  # whatever their order in a Signature
    points = points[as_on_grid]
    order = _from_the_middle(points)
    every = math.ceil(len(points) / _N_THICKNESS_POINTS)
    return points[order[every // 2 :: every]]


def _from_the_middle(points: Floats) -> Integers:
    """Return the order (P,) of points (P, 3) by their distance from their middle."""
    distances = _lengths(points - points.mean(axis=0))
    largest = max(distances.max(), TINY)  # a single point is the middle
    # Rounded, so that the order is that of a scaled body: its points are equally far from the middle but for rounding
    shares = np.round(distances / largest, 9)
    return np.argsort(shares, kind="stable")


def _lengths(vectors: Floats) -> Floats:
    """Return the lengths (N,) of vectors (N, 3), in a quarter of the time of `np.linalg.norm`."""
    return np.sqrt(dots(vectors, vectors))


def _unit(vectors: Floats) -> Floats:
    """Do what `igps.mesh.surface.unit` does, faster: here it is called some hundred times for each body."""
    divisors = np.maximum(_lengths(vectors), TINY)
    return vectors / divisors[:, None]


def _first_largest(values: Floats) -> Integers:
    """Return the index along the last axis of the first of the values that are largest but for rounding."""
    largest = values.max(axis=-1, keepdims=True)
    least = largest - 1e-9 * np.abs(largest)
    return np.asarray((values >= least).argmax(axis=-1))


class _NearestPoints:
    """Nearest points of a surface, looked for in the faces of the nearest samples.

    A search of the faces themselves takes a hundred times as long from points in the middle of a body, which are
    equally far from many faces.
    """

    def __init__(self, mesh: Mesh) -> None:
        n_samples = int(_SAMPLES_PER_THICKNESS * mesh.area**3 / mesh.volume**2)
        self._samples, sampled_faces = _even_samples(mesh, min(n_samples, _MAX_SAMPLES))
        # Many samples are equally far from the middle of a body: with large leaves, a query takes half of the time.
        self._tree = cKDTree(self._samples, leafsize=32)
        self._corners = mesh.vertices[mesh.faces[sampled_faces]]
        first = self._corners[:, 1] - self._corners[:, 0]
        second = self._corners[:, 2] - self._corners[:, 0]
        normal = np.cross(first, second)
        squares = np.maximum(dots(normal, normal), TINY)
        # A row of a face times a point minus the first corner is the point's weight at the second or the third corner
        rows = [np.cross(second, normal), np.cross(normal, first)]
        self._weights = np.stack(rows, axis=1) / squares[:, None, None]
        self._normals = _unit(normal)

    def depths(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the distances (P,) of points (P, 3) from the surface, negative outside, and the directions of growth.

        These are unit vectors (P, 3), away from the nearest point of the surface or, outside, towards it.
        """
        _, nearest = self._tree.query(points, _N_NEAREST)
        corners = self._corners[nearest]
        offsets = points[:, None] - corners[:, :, 0]
        weights = np.empty((*nearest.shape, 3))
        np.einsum("pkci,pki->pkc", self._weights[nearest], offsets, out=weights[..., 1:])
        weights[..., 0] = 1 - weights[..., 1] - weights[..., 2]
        # A point of the face near the nearest, which may be outside of it
        weights = np.maximum(weights, 0)
        weights /= np.einsum("pkc->pk", weights)[..., None]
        in_faces = np.einsum("pkc,pkci->pki", weights, corners)
        nearest_sample = self._samples[nearest[:, :1]]
        candidates = np.concatenate([in_faces, nearest_sample], axis=1)
        vectors = points[:, None] - candidates
        squared = np.einsum("pki,pki->pk", vectors, vectors)
        best = _first_largest(-squared)
        rows = np.arange(len(points))
        away = vectors[rows, best]
        best_face = nearest[rows, best % _N_NEAREST]
        is_outside = dots(away, self._normals[best_face]) > 0
        distances = np.sqrt(squared[rows, best])
        depths = np.where(is_outside, -1, 1) * distances
        growth = np.sign(depths)[:, None] * away
        return depths, _unit(growth)


def _even_samples(mesh: Mesh, n_samples: int) -> tuple[Floats, Integers]:
    """Return about `n_samples` positions (P, 3) evenly on the surface, and the faces (P,) on which they lie.

    They do not depend on the numbering of faces, as random ones would: from the middle of the body outward, each face
    gets its share by area, and is halved at its longest edge into as many pieces, whose centres are the samples.
    """
    corners = mesh.vertices[mesh.faces]
    areas = _lengths(area_vectors(mesh.vertices, mesh.faces))
    order = _from_the_middle(corners.mean(axis=1))
    ends = np.cumsum(areas[order]) * (n_samples / areas.sum())
    shares = np.diff(np.floor(ends), prepend=0)
    has_share = shares > 0
    faces = order[has_share]
    shares = shares[has_share]
    pieces = corners[faces]
    # Until each piece is about the share of one sample: halves would be farther from it than the whole
    while shares.max() > math.sqrt(2):
        is_large = shares > math.sqrt(2)
        kept = ~is_large
        first, second = _halves(pieces[is_large])
        half_share = shares[is_large] / 2
        halved = faces[is_large]
        pieces = np.concatenate([pieces[kept], first, second])
        shares = np.concatenate([shares[kept], half_share, half_share])
        faces = np.concatenate([faces[kept], halved, halved])
    return pieces.mean(axis=1), faces


def _halves(triangles: Floats) -> tuple[Floats, Floats]:
    """Return both halves (N, 3, 3) of triangles (N, 3, 3) that are cut from the middle of the longest edge."""
    edges = np.roll(triangles, -1, axis=1) - triangles
    longest = np.linalg.norm(edges, axis=2).argmax(axis=1)
    turned = (longest[:, None] + np.arange(3)) % 3
    corners = np.take_along_axis(triangles, turned[..., None], axis=1)
    start, end, opposite = corners.swapaxes(0, 1)
    middle = (start + end) / 2
    first = np.stack([start, middle, opposite], axis=1)
    second = np.stack([middle, end, opposite], axis=1)
    return first, second


def _moments(mesh: Mesh) -> tuple[Floats, Floats, Floats]:
    """Return the centroid (3,) of a body, its variances (3,) along the principal axes, ascending, and these as columns.

    The body is the signed sum of the tetrahedra over its faces. In a tetrahedron with corners 0, a, b and c, the mean
    of x xᵀ is (a aᵀ + b bᵀ + c cᵀ + s sᵀ)/20 with s = a + b + c.
    """
    origin = mesh.vertices.mean(axis=0)
    offsets = mesh.vertices - origin
    corners = offsets[mesh.faces]
    normals = np.cross(corners[:, 1], corners[:, 2])
    six_volumes = dots(corners[:, 0], normals)
    shares = six_volumes / six_volumes.sum()
    sums = corners.sum(axis=1)
    mean = shares @ sums / 4
    vectors = np.concatenate([corners, sums[:, None]], axis=1).reshape(-1, 3)
    weighted = np.repeat(shares, 4) * vectors.T
    second = weighted @ vectors / 20
    variances, axes = np.linalg.eigh(second - np.outer(mean, mean))
    return origin + mean, np.maximum(variances, 0), axes


def _diameter(corners: Floats) -> float:
    """Return the largest distance of points (P, 3), which is the largest width of the body along any direction."""
    height = (np.arange(_N_DIRECTIONS) + 0.5) / _N_DIRECTIONS
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(_N_DIRECTIONS)  # golden angle: evenly distributed
    ring = np.sqrt(1 - height**2)
    directions = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
    diameter = 0.0
    for _ in range(_N_DIAMETER_STEPS):
        along = directions @ corners.T
        foremost = corners[along.argmax(axis=1)]
        hindmost = corners[along.argmin(axis=1)]
        across = foremost - hindmost
        widths = _lengths(across)
        diameter = max(diameter, float(widths.max()))
        widest = np.argsort(widths)[-10:]
        directions = _unit(across[widest])
    return diameter


def _total_mean_curvature(mesh: Mesh, edge_of: Integers) -> float:
    """Return half the sum over edges of length times outer angle, which is negative at edges that go inward."""
    by_edge = np.argsort(edge_of, kind="stable")
    inner_edges = np.flatnonzero(np.bincount(edge_of) == 2)
    first = np.searchsorted(edge_of[by_edge], inner_edges)
    side = by_edge[first]
    other_side = by_edge[first + 1]
    normals = _unit(area_vectors(mesh.vertices, mesh.faces))
    left = normals[side // 3]
    right = normals[other_side // 3]
    start, end = directed_edges(mesh.faces)
    along = mesh.vertices[end[side]] - mesh.vertices[start[side]]  # as the left face goes round
    sine = dots(np.cross(left, right), _unit(along))
    cosine = dots(left, right)
    angles = np.arctan2(sine, cosine)
    return float(_lengths(along) @ angles) / 2


def _euler_number(mesh: Mesh, edges: Integers, edge_of: Integers) -> float:
    """Return the Euler number of a body, half of that of its surface; holes of an open surface count as closed."""
    n_vertices = len(mesh.vertices)
    is_boundary = np.bincount(edge_of) == 1
    n_holes = 0
    if is_boundary.any():
        rims = edges[is_boundary]
        n_parts, _ = components(rims, n_vertices)
        n_not_on_rims = n_vertices - len(np.unique(rims))
        n_holes = n_parts - n_not_on_rims
    return (n_vertices - len(edges) + len(mesh.faces) + n_holes) / 2
