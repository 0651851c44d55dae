"""How well the place in which two groups of an organ differ is found: the table of how-to/explain.md.

python -m docs.benchmarks.local_groups
"""

from __future__ import annotations

from collections.abc import Sequence

import igl
import numpy as np
import trimesh
from jsonargparse import auto_cli
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from sklearn.metrics import roc_auc_score
from training.shapes.bodies import Warp

from igps import as_mesh
from igps._arrays import Floats
from igps.analysis.local_difference import local_difference, offsets
from igps.cli import errors_as_messages
from igps.mesh.mesh import Mesh

EXTENT = 60.0  # mm
SPACING = 2.0  # mm
WIDTH = 0.1  # standard deviation of the changed place, over the square root of the area
TURN = 10.0  # degrees, of subjects


def local_groups(
    changes: Sequence[float] = (0.0, 0.01, 0.02, 0.03),
    n_organs: int = 5,
    n_each: int = 30,
    scatter: float = 0.04,
    seed: int = 1,
) -> None:
    """Print how well the changed place is found: area under the curve, and what the permutation test holds.

    An organ is a smooth random deformation of an ellipsoid. Each subject deforms it by a further one, lies turned by up
    to ten degrees, and is a mask of voxels. In one group, a place is pushed out.

    Args:
        changes: how far the place is pushed out, over the square root of the area.
        n_organs: number of organs, each with its own place, for each change.
        n_each: subjects of a group.
        scatter: strength of the deformation of subjects.
        seed: seed of organs and subjects.
    """
    for change in changes:
        areas = []
        inside = []
        outside = []
        for organ in range(n_organs):
            random = np.random.default_rng([seed, organ])
            found, held, false = measured(random, change, n_each, scatter)
            areas.append(found)
            inside.append(held)
            outside.append(false)
        spread = f"{np.mean(areas):.3f} ({min(areas):.3f} to {max(areas):.3f})"
        shares = f"{np.mean(inside):.2f} of the place, {np.mean(outside):.3f} elsewhere"
        wrong = sum(share > 0 for share in outside)
        print(f"{change:.0%}: AUC {spread}, significant {shares}, in {wrong} organs", flush=True)


def measured(
    random: np.random.Generator, change: float, n_each: int, scatter: float
) -> tuple[float, float, float]:
    """Return the area under the curve of one organ, and the significant shares of its place and of the rest."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    ellipsoid = ball.vertices * [0.5 * EXTENT, 0.35 * EXTENT, 0.25 * EXTENT]
    organ = Warp.draw(random, EXTENT, 0.4)(ellipsoid)
    normals = trimesh.Trimesh(organ, ball.faces, process=False).vertex_normals
    centre = organ[random.integers(len(organ))]
    width = WIDTH * np.sqrt(trimesh.Trimesh(organ, ball.faces, process=False).area)
    bump = np.exp(-np.square(organ - centre).sum(axis=1) / (2 * width**2))
    size = change * width / WIDTH
    pushed = organ + size * bump[:, None] * normals
    meshes = []
    surfaces = []
    for i in range(2 * n_each):
        rest = organ if i < n_each else pushed
        surface = subject(rest, scatter, random)
        surfaces.append(surface)
        meshes.append(scanned(surface, ball.faces))
    rows = [offsets(mesh, meshes[0]) for mesh in meshes]
    found = local_difference(np.array(rows), ["a"] * n_each + ["b"] * n_each)
    _, nearest = cKDTree(surfaces[0]).query(meshes[0].vertices)
    is_place = bump[nearest] > 0.5
    area = roc_auc_score(is_place, np.abs(found.offset))
    is_far = bump[nearest] < 0.05
    held = found.is_significant
    return float(area), float(held[is_place].mean()), float(held[is_far].mean())


def subject(rest: Floats, scatter: float, random: np.random.Generator) -> Floats:
    """Return the vertices of a subject: deformed, and turned."""
    deformed = Warp.draw(random, EXTENT, scatter)(rest)
    turn = Rotation.from_rotvec(np.radians(random.uniform(-TURN, TURN, 3)) / np.sqrt(3))
    return np.asarray(turn.apply(deformed))


def scanned(vertices: Floats, faces: np.ndarray) -> Mesh:
    """Return the surface of the voxels of a body, in the frame of the patient."""
    low = vertices.min(axis=0) - 2 * SPACING
    n = np.ceil((vertices.max(axis=0) + 2 * SPACING - low) / SPACING).astype(int)
    grid = np.stack(np.indices(n), axis=-1).reshape(-1, 3) * SPACING + low
    winding = igl.fast_winding_number(vertices, faces.astype(np.int64), grid)
    mask = (winding > 0.5).reshape(n)
    mesh = as_mesh(mask, (SPACING,) * 3)
    return Mesh(mesh.vertices + low, mesh.faces, unit="mm", frame="RAS")


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(local_groups)
