"""Surfaces as they come: other triangles, simplified, noisy, mirrored, made watertight; turned, moved and scaled."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from igps._arrays import Floats
from igps.mesh import surface
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.simplification import simplify
from igps.mesh.watertight import watertight

# Shares of the shapes to which each happens.
_SIMPLIFIED, _NOISY, _MIRRORED, _WATERTIGHT = 0.4, 0.35, 0.25, 0.15
# How many more vertices there are before a surface is simplified.
_SURPLUS = 1.6
# Standard deviation of the noise, over the root of the mean area of a face: the triangles stay as they lie.
_NOISE = 0.05
_RESOLUTION = 72


@dataclass(frozen=True)
class Scan:
    """What happens to the surface of one pose."""

    n_vertices: int  # that it has afterwards, about
    is_simplified: bool  # from more vertices; otherwise it is meshed with as many
    noise: float  # standard deviation along the normals, over the root of the mean area of a face; 0 for none
    is_mirrored: bool  # left and right are exchanged
    is_watertight: bool  # it is made again from a grid of distances
    motion: Floats  # (3,3) orthogonal: a rotation, of a mirrored surface with a reflection
    scale: float  # factor of all lengths
    offset: Floats  # (3,) in units of the scaled size

    @classmethod
    def draw(cls, rng: np.random.Generator, n_vertices: tuple[int, int]) -> Scan:
        """Draw what happens; vertices between the two numbers, small ones as often as large ones by ratio."""
        low, high = np.log(n_vertices)
        chances = rng.uniform(size=4) < (_SIMPLIFIED, _NOISY, _MIRRORED, _WATERTIGHT)
        motion = np.asarray(Rotation.from_quat(rng.normal(size=4)).as_matrix())
        return cls(
            n_vertices=int(np.exp(rng.uniform(low, high))),
            is_simplified=bool(chances[0]),
            noise=float(_NOISE * rng.uniform(0.2, 1.0) * chances[1]),
            is_mirrored=bool(chances[2]),
            is_watertight=bool(chances[3]),
            motion=motion * (-1.0 if chances[2] else 1.0),
            scale=float(np.exp(rng.uniform(-2.0, 2.0))),
            offset=rng.uniform(-2.0, 2.0, 3),
        )

    @property
    def target(self) -> int:
        """Vertices to mesh the body with."""
        return int(self.n_vertices * (_SURPLUS if self.is_simplified else 1.0))

    def of(self, mesh: Mesh, rng: np.random.Generator) -> Mesh:
        """The surface after all this.

        Raises:
            MeshError: it is no body any more.
        """
        genus = mesh.genus
        if self.is_simplified:
            mesh = simplify(mesh, self.n_vertices)
        if self.noise > 0.0:
            edge = np.sqrt(mesh.area / len(mesh.faces))
            steps = self.noise * edge * rng.normal(size=(len(mesh.vertices), 1))
            vertices = mesh.vertices + steps * surface.vertex_normals(mesh.vertices, mesh.faces)
            mesh = Mesh(vertices, mesh.faces, mesh.name, notes=(*mesh.notes, "noise along the normals"))
        if self.is_watertight:
            # Limbs that nearly touch grow together on a coarse grid: then the surface stays as it was.
            closed = watertight(
                mesh.vertices, mesh.faces, resolution=_RESOLUTION, max_vertices=self.n_vertices, name=mesh.name
            )
            if closed.genus == genus:
                mesh = Mesh(closed.vertices, closed.faces, mesh.name, notes=(*mesh.notes, *closed.notes))
        if mesh.genus != genus:
            raise MeshError(f"{mesh.name}: genus {mesh.genus} in place of {genus}.")
        centred = mesh.vertices - mesh.vertices.mean(axis=0)
        turned = (centred[:, None] * self.motion[None]).sum(axis=2)
        faces = mesh.faces[:, ::-1] if self.is_mirrored else mesh.faces
        notes = (*mesh.notes, "mirrored") if self.is_mirrored else mesh.notes
        return Mesh(self.scale * (turned + self.offset), faces, mesh.name, notes=notes)
