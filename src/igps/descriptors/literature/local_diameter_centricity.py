"""Pose-oblivious signature of local diameter and centricity (Gal, Shamir and Cohen-Or 2007)."""

import numpy as np

from igps._arrays import Floats, Integers, Singles
from igps.data.batch import Body
from igps.data.requirements import Requirements
from igps.descriptors.literature._linear_histogram import linear_histogram
from igps.descriptors.literature.geodesics import farthest_points
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.surface import area_vectors, longest_side, unit, vertex_areas
from igps.nn.descriptor import BodyDescriptor
from igps.signature.ordering import in_canonical_order
from igps.signature.sampling import surface_points

# Depth below the surface at which rays start, so that they do not hit their own face, in longest sides of the body.
_RAY_OFFSET = 1e-6
# For the graph of geodesics. Distances are 1 % longer than with two points, and take less than half the time.
_POINTS_PER_EDGE = 1


class LocalDiameterCentricity(BodyDescriptor):
    """Joint histogram of the local diameter and the centricity over the surface, both in units of √area.

    Source: Gal, Shamir and Cohen-Or 2007. The cone and the statistics of its rays follow Shapira, Shamir and Cohen-Or
    2008. The distance is χ², one of the histogram distances that the source compares.
    """

    name = "local_diameter_centricity"
    source = "Gal, Shamir and Cohen-Or 2007"
    invariant_to = ("motion", "scale", "pose")
    requirements = Requirements(mesh=True)

    n_diameter_bins = 32  # with a linear kernel
    n_centricity_bins = 32  # with a linear kernel
    # Upper end of the last bin, in units of √area; larger values go into this bin
    max_diameter = 0.45
    max_centricity = 2.0  # the same for the centricity
    n_samples = 2000  # area-weighted random points of the surface
    n_rays = 30  # per sample
    opening_angle = 120.0  # of the cone about the inward normal, degrees
    n_sources = 40  # points of the surface over which the geodesic distances are averaged

    def describe_body(self, body: Body) -> Singles:
        """(n_diameter_bins, n_centricity_bins) histogram of sum 1; a MeshError if no ray meets the far side."""
        mesh = in_canonical_order(body.mesh)
        points = surface_points(mesh, self.n_samples, seed=0)
        diameter = local_diameters(
            mesh, points.face, points.weights, self.n_rays, self.opening_angle
        )
        central = points.interpolate(centricity(mesh, self.n_sources)[:, None])[:, 0]
        valid = np.isfinite(diameter)
        if not valid.any():
            raise MeshError(
                f"{mesh.name}: no ray from the surface inwards meets its far side. Close the surface or repair it."
            )
        scale = np.sqrt(mesh.area)
        diameter_ratio = diameter[valid] / scale / self.max_diameter
        centricity_ratio = central[valid] / scale / self.max_centricity
        n_bins = [self.n_diameter_bins, self.n_centricity_bins]
        histogram = linear_histogram([diameter_ratio, centricity_ratio], n_bins)
        return histogram.astype(np.float32)


def local_diameters(
    mesh: Mesh, face: Integers, weights: Floats, n_rays: int, opening_angle: float
) -> Floats:
    """Thickness (P,) of the body at points of its surface: the mean length of inward rays, without outliers.

    Points are given by their faces (P,) and barycentric weights (P, 3). From each point, rays fill a cone about the
    inward normal evenly; its opening angle is in degrees. A ray is valid if it meets the surface from within. The
    lengths of valid rays within a standard deviation of their median are averaged (Shapira et al. 2008, section 3).
    The thickness is NaN where no ray is valid.
    """
    import igl

    centre = mesh.vertices.mean(axis=0)
    size = longest_side(mesh.vertices)
    vertices = np.asfortranarray((mesh.vertices - centre) / size)
    faces = np.asfortranarray(mesh.faces)
    normals = unit(area_vectors(vertices, mesh.faces))
    # The frame of the rays contains an edge of the face, so that the rays rotate with the body.
    corner = vertices[faces[face]]
    inward = -normals[face]
    side = unit(corner[:, 1] - corner[:, 0])
    frame = np.stack([side, np.cross(inward, side), inward], axis=1)
    directions = np.einsum("rk,pkj->prj", _cone(n_rays, opening_angle), frame)
    origins = np.einsum("pi,pij->pj", weights, corner) + _RAY_OFFSET * inward
    tree = igl.AABB()
    tree.init(vertices, faces)
    rays = directions.reshape(-1, 3)
    starts = np.repeat(origins, n_rays, axis=0)
    hit, length, _ = tree.intersect_ray_first(vertices, faces, starts, rays)
    is_from_within = np.einsum("ij,ij->i", normals[hit], rays) > 0
    valid = (hit >= 0) & is_from_within
    lengths = np.where(valid, length, np.nan)
    return size * _robust_mean(lengths.reshape(-1, n_rays))


def centricity(mesh: Mesh, n_sources: int) -> Floats:
    """(V,) mean geodesic distance of each vertex from the whole surface.

    The mean is over at most `n_sources` vertices by farthest-point sampling, each weighted by the area nearest to it.
    """
    n_samples = min(n_sources, len(mesh.vertices))
    distances = farthest_points(mesh, n_samples, _POINTS_PER_EDGE).distances
    area = vertex_areas(mesh.vertices, mesh.faces)
    nearest = np.argmin(distances, axis=0)
    weight = np.bincount(nearest, area, len(distances))
    return weight @ distances / weight.sum()


def _cone(n_rays: int, opening_angle: float) -> Floats:
    """(R, 3) unit vectors in a cone about the third axis, on a golden spiral of equal solid angles (Vogel 1979)."""
    rank = np.arange(n_rays) + 0.5
    cosine = 1 - rank / n_rays * (1 - np.cos(np.radians(opening_angle / 2)))
    azimuth = rank * np.pi * (3 - np.sqrt(5))
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=1)


def _robust_mean(lengths: Floats) -> Floats:
    """Mean of the values of each row within a standard deviation of their median; NaN for a row of NaN alone."""
    values = np.ma.masked_invalid(lengths)
    median = np.ma.median(values, axis=1, keepdims=True)
    deviation = values.std(axis=1, keepdims=True)
    # The tolerance keeps lengths that differ from the median by rounding alone.
    is_outlier = np.abs(values - median) > deviation + 1e-9 * median
    trimmed = np.ma.masked_where(is_outlier, values)
    # If an even number of lengths forms two distant groups, none may be near the median. Then all are averaged.
    has_any = trimmed.count(axis=1) > 0
    means = np.ma.where(has_any, trimmed.mean(axis=1), values.mean(axis=1))
    return np.asarray(means.filled(np.nan))
