"""Closed forms of the mean value weights and the solid angles of triangles.

The weights are those of ``∫ f·h/r⁴ dS`` for a piecewise linear ``f``, ``r`` being the distance from a point to the
surface point and ``h`` that to its tangent plane, positive on the inner side (Ju, Schaefer, Warren 2005).
Two arrangements:

* `FaceBlock`, dense: for all pairs of face and point, each vertex, edge and face of a mesh visited once;
* `ListedRule`: for a list of pairs of face and point, accurate on and near a face.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np
import torch

from igps._compiled import is_available
from igps.signature._weight_loops import replace_weights

__all__ = ["FaceBlock", "ListedRule", "Surface", "Tile", "has_area", "spatial_order", "squared_distances"]

_ROOT_EPS = 2.0**-26  # flatter faces (height / length) are left out
_ON_SURFACE = 2e-9  # half-diagonals: closer points take the surface value, and coplanar faces count as exactly so


@dataclass(frozen=True)
class Tile:
    """How many faces and points are worked on at a time: on a CPU a tile stays in the second-level cache."""

    faces: int
    points: int
    hats: int
    pairs: int

    @staticmethod
    def of(device: torch.device) -> Tile:
        return Tile(1024, 128, 256, 2**13) if device.type == "cpu" else Tile(2**12, 2**10, 2**11, 2**17)


@dataclass(frozen=True)
class Surface:
    """A scaled mesh without its flat faces. Side l of a face is opposite to its corner l and runs from l+1 to l+2."""

    vertices: torch.Tensor  # (V, 3)
    faces: torch.Tensor  # (F, 3)
    normals: torch.Tensor  # (F, 3), unit
    double_areas: torch.Tensor  # (F,)
    inward: torch.Tensor  # (F, 3, 3): in the face's plane, across side l, as long as it
    squared_sides: torch.Tensor  # (F, 3)

    @staticmethod
    def of(vertices: torch.Tensor, faces: torch.Tensor) -> Surface:
        corners = vertices[faces]
        keep = has_area(corners)
        sides = corners.roll(-2, dims=1) - corners.roll(-1, dims=1)
        area_vectors = torch.linalg.cross(sides[:, 0], sides[:, 1])
        double_areas = area_vectors.norm(dim=1)
        squared_sides = sides.square().sum(-1)
        normals = area_vectors[keep] / double_areas[keep, None]
        inward = torch.linalg.cross(normals[:, None].expand(-1, 3, -1), sides[keep])
        return Surface(vertices, faces[keep], normals, double_areas[keep], inward, squared_sides[keep])


def has_area(corners: torch.Tensor) -> torch.Tensor:
    """(F,) whether a triangle (F, 3, 3) is one to rounding; coordinates of the order of 1."""
    a, b, c = corners.unbind(1)
    longest = torch.stack([(one - two).square().sum(1) for one, two in ((b, c), (c, a), (a, b))]).amax(0)
    return torch.linalg.cross(c - b, a - c).norm(dim=1) > _ROOT_EPS * longest


def squared_distances(one: torch.Tensor, two: torch.Tensor) -> torch.Tensor:
    """(n, m) between points (n, 3) and (m, 3), from differences: exact to rounding at any distance."""
    squared = (one[:, 0, None] - two[:, 0]).square_()
    for axis in (1, 2):
        difference = one[:, axis, None] - two[:, axis]
        squared.addcmul_(difference, difference)
    return squared


def spatial_order(points: torch.Tensor, size: int) -> torch.Tensor:
    """An order (n,) of points (n, 3) in which all runs of size·2ᵏ, counted from the start, are compact in space.

    The median cut: halves along the longest side of their bounding box, again and again.
    """
    n_points = len(points)
    n_cuts = max(0, math.ceil(math.log2(max(1, n_points) / size)))
    order = np.minimum(np.arange(size << n_cuts), n_points)
    # What is missing to 2ᵏ full runs is in the middle for the boxes, and behind all points for the cuts.
    padded = torch.cat([points, points.mean(0, keepdim=True)]).T.contiguous().cpu().numpy()
    for cut in range(n_cuts):
        boxes = padded.take(order, axis=1).reshape(3, 1 << cut, -1)
        low, high = torch.from_numpy(boxes).aminmax(dim=2)
        along = boxes[(high - low).argmax(0).numpy(), np.arange(1 << cut)]
        along[order.reshape(along.shape) == n_points] = np.inf
        halves = np.argpartition(along, along.shape[1] // 2 - 1, axis=1)
        order = np.take_along_axis(order.reshape(along.shape), halves, axis=1).ravel()
    return torch.as_tensor(order[order < n_points], device=points.device)


@dataclass(frozen=True)
class ListedRule:
    """Exact weights of single (face, point) pairs, accurate up to the surface."""

    faces: torch.Tensor  # (F, 3)
    table: torch.Tensor  # (F, 22): corners, normal, two inward vectors, squared sides, double area
    first: torch.Tensor  # (V + 1,): where the faces of a vertex begin in `around`
    around: torch.Tensor  # (3F,)

    @staticmethod
    def of(surface: Surface) -> ListedRule:
        faces = surface.faces
        corners, inward = surface.vertices[faces].flatten(1), surface.inward[:, :2].flatten(1)
        parts = [corners, surface.normals, inward, surface.squared_sides, surface.double_areas[:, None]]
        around = faces.flatten().argsort(stable=True) // 3
        counts = faces.flatten().bincount(minlength=len(surface.vertices))
        first = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        return ListedRule(faces, torch.cat(parts, 1), first, around)

    def replace(self, points: torch.Tensor, near: torch.Tensor, rows: torch.Tensor, weights: torch.Tensor) -> None:
        """Replace the weights (R, n) of the pairs near (2, m) of a vertex and a point by exact ones.

        Rows (V,) says which row of the weights is a vertex's; all those without one share a row that is never near.
        Points on the surface get only their triangle's weights.
        """
        if points.device.type == "cpu" and is_available():
            replace_weights(
                points.numpy(), near.numpy(), rows.numpy(), self.faces.numpy(), self.table.numpy(), self.first.numpy(),
                self.around.numpy(), _ON_SURFACE, weights.numpy(),
            )  # fmt: skip
            return
        n_points, flat_weights = len(points), weights.view(-1)
        cells = rows[near[0]] * n_points + near[1]
        flat_weights.index_fill_(0, cells, 0)
        mask = torch.zeros_like(flat_weights, dtype=torch.bool).index_fill_(0, cells, True)
        touching: list[tuple[torch.Tensor, ...]] = []
        for hat, column in near.split(Tile.of(points.device).pairs, 1):
            counts = self.first[hat + 1] - self.first[hat]
            source = torch.repeat_interleave(counts)
            offset = torch.arange(len(source), device=hat.device) - (counts.cumsum(0) - counts).index_select(0, source)
            hat, column = hat.index_select(0, source), column.index_select(0, source)
            face = self.around.index_select(0, self.first.index_select(0, hat) + offset)
            corner = self.faces.index_select(0, face).T
            cells = rows[corner] * n_points + column
            is_near = mask.index_select(0, cells.flatten()).view(3, -1)
            # A face counts once: with its first near corner.
            keep = (is_near & (corner < hat)).any(0).logical_not_().nonzero()[:, 0]
            face, column = face.index_select(0, keep), column.index_select(0, keep)
            values, barycentric, on_face = self.weights(face, points.index_select(0, column).T.contiguous())
            values.masked_fill_(~is_near.index_select(1, keep), 0)
            flat_weights.index_add_(0, cells.index_select(1, keep).flatten(), values.flatten().to(weights.dtype))
            if bool(on_face.any()):
                touching.append((column[on_face], self.faces[face[on_face]], barycentric.T[on_face]))
        if touching:
            column, corner, values = (torch.cat(parts) for parts in zip(*touching, strict=True))
            first = np.unique(column.cpu().numpy(), return_index=True)[1]
            chosen = torch.as_tensor(first, device=column.device)
            weights[:, column[chosen]] = 0
            weights[rows[corner[chosen]], column[chosen, None]] = values[chosen].to(weights.dtype)

    def weights(self, faces: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """For faces (n,) and points (3, n): weights and barycentric coordinates (3, n), and which lie on their face.

        With λ the barycentric coordinates of the projection of x, h its distance to the plane, e_l the sides, N_l the
        product of the vectors from x to the ends of side l and θ_l the angle between them, the published
        N_i·m / (N_i·v_i) becomes ½ [λ_i s/h + h Σ_l g_l e_l·e_i / |n|²] |n|, with g_l = θ_l/|N_l| and s = Σ_l g_l λ_l,
        because N_l = λ_l n + h n̂×e_l. The length of N_l taken from that too makes all terms agree near side l.
        """
        table = self.table.index_select(0, faces).T.contiguous()
        a, b, c = (table[3 * i : 3 * i + 3] - points for i in range(3))
        squared_sides, double_area = table[18:21], table[21]
        h = (table[9:12] * a).sum(0)
        areas = torch.empty_like(squared_sides)  # of the projection with each side, doubled: λ |n|
        torch.sum(table[12:15] * b, 0, out=areas[0]).neg_()
        torch.sum(table[15:18] * c, 0, out=areas[1]).neg_()
        torch.sub(double_area, areas[0], out=areas[2]).sub_(areas[1])
        lengths = areas.square().addcmul_(squared_sides, h.square()).sqrt_().clamp_min_(1e-150)
        cosines = torch.stack([(b * c).sum(0), (c * a).sum(0), (a * b).sum(0)])
        g = torch.atan2(lengths, cosines).div_(lengths)
        s = (g * areas).sum(0)
        # In the plane of a face but outside it s vanishes like h², the weight like h: what is left is rounding.
        outside = (h.abs() < _ON_SURFACE) & (s < 1e-2)
        first = torch.where(outside, 0, s / h) * areas
        products = squared_sides - squared_sides.sum(0) / 2  # of the two other sides
        second = g * squared_sides
        second.addcmul_(g.roll(1, 0), products.roll(2, 0)).addcmul_(g.roll(2, 0), products.roll(1, 0))
        weights = second.mul_(h).add_(first).div_(2 * double_area)
        on_face = (h.abs() <= _ON_SURFACE) & (areas >= -_ON_SURFACE * squared_sides.sqrt()).all(0)
        barycentric = areas.clamp_min(0)
        return weights, barycentric / barycentric.sum(0), on_face


@dataclass(frozen=True)
class FaceBlock:
    """Faces that lie close together, with the vertices and edges they use, numbered within the block."""

    vertex_ids: torch.Tensor  # (v,) in the mesh
    vertices: torch.Tensor  # (v, 3)
    edges: torch.Tensor  # (2, e)
    squared_edges: torch.Tensor  # (e, 1)
    faces: torch.Tensor  # (3, f)
    face_edges: torch.Tensor  # (3, f)
    gradients: torch.Tensor  # (3f, 3): h, λ₁|n| and λ₂|n| as gradient · (origin − x)
    origins: torch.Tensor  # (3f, 3)
    double_areas: torch.Tensor  # (f, 1)
    gather: torch.Tensor  # (v, 5f), sparse: from the quantities of the faces to the weights of the vertices

    @staticmethod
    def of(surface: Surface, chosen: torch.Tensor) -> FaceBlock:
        vertex_ids, local = surface.faces[chosen].unique(return_inverse=True)
        n_vertices = len(vertex_ids)
        ends = torch.stack([local.roll(-1, 1), local.roll(-2, 1)], -1).sort(-1).values
        keys, face_edges = (ends[..., 0] * n_vertices + ends[..., 1]).unique(return_inverse=True)
        edges = torch.stack([keys // n_vertices, keys % n_vertices])
        vertices = surface.vertices[vertex_ids]
        squared_edges = (vertices[edges[0]] - vertices[edges[1]]).square().sum(1, keepdim=True)
        gradients = torch.cat([surface.normals[chosen], -surface.inward[chosen, 0], -surface.inward[chosen, 1]])
        origins = vertices[local].transpose(0, 1).flatten(0, 1)  # h is 0 at corner 0, λ₁ at corner 1, λ₂ at corner 2
        double_areas = surface.double_areas[chosen]
        gather = _gather_matrix(local, surface.squared_sides[chosen], double_areas, n_vertices)
        return FaceBlock(
            vertex_ids=vertex_ids,
            vertices=vertices,
            edges=edges,
            squared_edges=squared_edges,
            faces=local.T.contiguous(),
            face_edges=face_edges.T.contiguous(),
            gradients=gradients,
            origins=origins,
            double_areas=double_areas[:, None],
            gather=gather,
        )

    def _affine(self, points: torch.Tensor, n_rows: int) -> torch.Tensor:
        """The first rows of gradient · (origin − x), taken about the centre of the points to keep rounding small."""
        centre = points.mean(0)
        gradients = self.gradients[:n_rows]
        offsets = (gradients * (self.origins[:n_rows] - centre)).sum(1, keepdim=True)
        local = torch.cat([centre - points, torch.ones_like(points[:, :1])], 1)
        return torch.cat([gradients, offsets], 1) @ local.T

    def add_weights(self, points: torch.Tensor, weights: torch.Tensor) -> None:
        """Add the weights of these faces to weights (V, n). Where a point nearly touches an edge they are unusable.

        The formula of `ListedRule.weights`, with θ and |N| of an edge from its length and the distances of its ends:
        tan² θ/2 = (l² − (r − r')²) / ((r + r')² − l²), so that g = 4 A(tan² θ/2) / ((r + r')² − l²), A(t²) = atan(t)/t.
        """
        n_faces = self.faces.shape[1]
        distances = squared_distances(self.vertices, points).sqrt_()
        one, two = (distances.index_select(0, ends) for ends in self.edges)
        total = one + two
        total = torch.addcmul(-self.squared_edges, total, total, out=total)
        tangent = one.sub_(two)
        tangent = torch.addcmul(self.squared_edges, tangent, tangent, value=-1, out=tangent)
        tangent.div_(total).clamp_min_(1e-30).sqrt_()
        edge_g = torch.atan(tangent, out=two).div_(tangent.mul_(total))  # a quarter of g; the matrix has the 4

        affine = self._affine(points, 3 * n_faces)
        h, first, second = affine[:n_faces], affine[n_faces : 2 * n_faces], affine[2 * n_faces :]
        h = torch.nn.functional.hardshrink(h, _ON_SURFACE)  # coplanar points: no weight
        g = edge_g.index_select(0, self.face_edges[2])
        rows = affine.new_empty(5 * n_faces, len(points))
        first_out, second_out, ratio, first_h, second_h = rows.view(5, n_faces, -1).unbind(0)
        torch.index_select(edge_g, 0, self.face_edges[0], out=first_h).sub_(g)
        torch.index_select(edge_g, 0, self.face_edges[1], out=second_h).sub_(g)
        torch.mul(g, self.double_areas, out=ratio).addcmul_(first_h, first).addcmul_(second_h, second)
        torch.nan_to_num_(ratio.div_(h), nan=0.0, posinf=0.0, neginf=0.0)
        torch.mul(ratio, first, out=first_out)
        torch.mul(ratio, second, out=second_out)
        first_h.mul_(h)
        second_h.mul_(h)
        weights.index_add_(0, self.vertex_ids, (self.gather @ rows).to(weights.dtype))

    def solid_angles(self, points: torch.Tensor) -> torch.Tensor:
        """Sum (n,) of the solid angles of these faces, positive from the inside."""
        distances = squared_distances(self.vertices, points).sqrt_()
        one, two = (distances.index_select(0, ends) for ends in self.edges)
        cosines = one.square_().addcmul_(two, two).sub_(self.squared_edges).mul_(0.5)
        corners = [distances.index_select(0, corner) for corner in self.faces]
        denominator = corners[0] * corners[1] * corners[2]
        for corner, index in zip(corners, self.face_edges, strict=True):
            denominator.addcmul_(corner, cosines.index_select(0, index))
        volume = self._affine(points, self.faces.shape[1]).mul_(self.double_areas)
        return torch.atan2(volume, denominator, out=volume).sum(0).mul_(2)


def face_blocks(surface: Surface, size: int) -> list[FaceBlock]:
    """The faces in blocks of size, each compact in space."""
    order = spatial_order(surface.vertices[surface.faces].mean(1), size)
    return [FaceBlock.of(surface, chosen) for chosen in order.split(size)]


def _gather_matrix(
    faces: torch.Tensor, squared_sides: torch.Tensor, double_areas: torch.Tensor, n_vertices: int
) -> torch.Tensor:
    """Sparse (V, 5F): weights from s/h·λ₁|n|, s/h·λ₂|n|, s/h, h(g₁−g₃), h(g₂−g₃) of each face, with g/4 for g."""
    n_faces = len(faces)
    scale = 4 / (2 * double_areas)
    products = squared_sides - squared_sides.sum(1, keepdim=True) / 2  # of the two other sides
    column = torch.arange(n_faces, device=faces.device)
    entries = [
        (0, 0, scale), (1, 1, scale), (2, 0, -scale), (2, 1, -scale), (2, 2, scale * double_areas),
        (0, 3, scale * squared_sides[:, 0]), (1, 3, scale * products[:, 2]), (2, 3, scale * products[:, 1]),
        (0, 4, scale * products[:, 2]), (1, 4, scale * squared_sides[:, 1]), (2, 4, scale * products[:, 0]),
    ]  # fmt: skip
    indices = torch.stack(
        [
            torch.cat([faces[:, corner] for corner, _, _ in entries]),
            torch.cat([quantity * n_faces + column for _, quantity, _ in entries]),
        ]
    )
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse", category=UserWarning)  # beta, says torch; tested here
        values = torch.cat([value for _, _, value in entries])
        coo = torch.sparse_coo_tensor(indices, values, (n_vertices, 5 * n_faces), check_invariants=True)
        return coo.to_sparse_csr()
