"""Surfaces as from scanners and files: simplified, noisy, mirrored, made watertight, rotated, moved and scaled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from igps._arrays import Floats
from igps.mesh import surface
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.simplification import simplify
from igps.mesh.watertight import watertight

# Probability of each change.
_SIMPLIFIED = 0.4
_NOISY = 0.35
_MIRRORED = 0.25
_WATERTIGHT = 0.15
# Ratio of the numbers of vertices before and after simplification.
_SURPLUS = 1.6
# Largest standard deviation of the noise, over the root of the mean area of a face; too small to flip triangles.
_MAX_NOISE = 0.05
_RESOLUTION = 72  # voxels along the longest side, to make a surface watertight


@dataclass(frozen=True)
class Scan:
    """Changes of the surface of a pose."""

    n_vertices: int  # approximate number of vertices of the result
    is_simplified: bool  # from a finer mesh; otherwise the surface is meshed with `n_vertices`
    noise: float  # standard deviation along the normals, over the root of the mean area of a face; 0 for no noise
    is_mirrored: bool
    is_watertight: bool  # the surface is reconstructed from a grid of distances
    motion: Floats  # (3,3) orthogonal: a rotation, with a reflection if the surface is mirrored
    scale: float  # factor of all lengths
    offset: Floats  # (3,) translation after the rotation and before the scaling

    @classmethod
    def draw(cls, rng: np.random.Generator, n_vertices: tuple[int, int]) -> Scan:
        """Draw changes; the number of vertices is log-uniform between the two numbers."""
        low, high = np.log(n_vertices)
        chances = rng.uniform(size=4) < (_SIMPLIFIED, _NOISY, _MIRRORED, _WATERTIGHT)
        motion = np.asarray(Rotation.from_quat(rng.normal(size=4)).as_matrix())
        return cls(
            n_vertices=int(np.exp(rng.uniform(low, high))),
            is_simplified=bool(chances[0]),
            noise=float(_MAX_NOISE * rng.uniform(0.2, 1.0) * chances[1]),
            is_mirrored=bool(chances[2]),
            is_watertight=bool(chances[3]),
            motion=motion * (-1.0 if chances[2] else 1.0),
            scale=float(np.exp(rng.uniform(-2.0, 2.0))),
            offset=rng.uniform(-2.0, 2.0, 3),
        )

    @property
    def target(self) -> int:
        """Number of vertices to mesh the body with."""
        return int(self.n_vertices * (_SURPLUS if self.is_simplified else 1.0))

    def of(self, mesh: Mesh, rng: np.random.Generator) -> Mesh:
        """Return the surface after all changes.

        Raises:
            MeshError: the result is not a valid body, or has another genus.
        """
        genus = mesh.genus
        if self.is_simplified:
            mesh = simplify(mesh, self.n_vertices)
        if self.noise > 0.0:
            edge = np.sqrt(mesh.area / len(mesh.faces))
            steps = self.noise * edge * rng.normal(size=(len(mesh.vertices), 1))
            vertices = mesh.vertices + steps * surface.vertex_normals(mesh.vertices, mesh.faces)
            notes = (*mesh.notes, "noise along the normals")
            mesh = Mesh(vertices, mesh.faces, mesh.name, notes=notes)
        if self.is_watertight:
            # Limbs that nearly touch may merge on a coarse grid. In this case the surface is left unchanged.
            closed = watertight(
                mesh.vertices,
                mesh.faces,
                resolution=_RESOLUTION,
                max_vertices=self.n_vertices,
                name=mesh.name,
            )
            if closed.genus == genus:
                notes = (*mesh.notes, *closed.notes)
                mesh = Mesh(closed.vertices, closed.faces, mesh.name, notes=notes)
        if mesh.genus != genus:
            raise MeshError(f"{mesh.name}: expected genus {genus}, got {mesh.genus}.")
        centred = mesh.vertices - mesh.vertices.mean(axis=0)
        turned = (centred[:, None] * self.motion[None]).sum(axis=2)
        vertices = self.scale * (turned + self.offset)
        if not self.is_mirrored:
            return Mesh(vertices, mesh.faces, mesh.name, notes=mesh.notes)
        notes = (*mesh.notes, "mirrored")
        return Mesh(vertices, mesh.faces[:, ::-1], mesh.name, notes=notes)
