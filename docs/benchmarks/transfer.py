"""How well descriptors tell individuals apart that have the poses of one scanned body: a table of transfer.md.

python -m docs.benchmarks.transfer KIDS
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.sparse
import trimesh
from jsonargparse import auto_cli
from scipy.sparse.linalg import splu
from training.generated import usable_shapes
from training.shapes.individuals import Change

import igps
from igps._arrays import Floats, Integers
from igps.cli import errors_as_messages
from igps.nn.description import describe
from igps.retrieval import retrieval_scores

# Smallest and largest displacement of an individual from the scanned body, in units of √area.
SHARES = (0.04, 0.1)
DESCRIPTORS = ("interior", "gps", "shape_dna", "multiscale", "rich", "pretrained")


def people(
    data: Path,
    root: Path = Path("build/people"),
    descriptors: Sequence[str] = DESCRIPTORS,
    n_individuals: int = 10,
    seed: int = 0,
    cache_dir: Path | None = None,
    n_workers: int | None = None,
) -> None:
    """Print the scores of generated individuals of scanned bodies, each in all scanned poses of its body.

    An individual is the first mesh of a folder with a smooth change of 4 to 10 % of √area. Deformation transfer (Sumner
    and Popović 2004) carries the change to the other poses. Each body is scored by itself.

    Args:
        data: folder with one subfolder for each body. Its meshes are poses with the same vertices and faces.
        root: folder of the generated meshes.
        descriptors: names of descriptors.
        n_individuals: number of individuals of each body.
        seed: seed of the changes.
        cache_dir: folder of cached signatures; by default the user's cache directory.
        n_workers: processes; by default all cores.

    Raises:
        ValueError: a mesh has other faces than the first mesh of its folder.
    """
    folders = sorted(path for path in data.iterdir() if path.is_dir())
    for number, folder in enumerate(folders):
        generator = np.random.default_rng([seed, number])
        vertices, faces = read_poses(folder)
        own = root / folder.name
        for individual in range(n_individuals):
            change = Change.draw(generator, vertices[0], faces, SHARES)
            target = own / str(individual)
            target.mkdir(parents=True, exist_ok=True)
            moved = transfer(vertices[0], vertices, change(vertices[0]), faces)
            for pose, surface in enumerate(moved):
                trimesh.Trimesh(surface, faces, process=False).export(target / f"{pose}.off")
        for name in descriptors:
            descriptor = igps.descriptor(name)
            dataset = igps.SignatureDataset(own, descriptor=descriptor, cache_dir=cache_dir)
            shapes = usable_shapes(dataset, n_workers)
            described = describe(shapes, descriptor, n_workers=n_workers)
            distances = descriptor.distances(described, described)
            scores = retrieval_scores(distances, shapes.labels).mean()
            nn = 100 * scores["nn"]
            ft = 100 * scores["ft"]
            print(f"{folder.name} {name}: NN {nn:.1f} FT {ft:.1f}", flush=True)


def read_poses(folder: Path) -> tuple[list[Floats], Integers]:
    """Return the vertices (V, 3) of each mesh of a folder, and their common faces (F, 3)."""
    files = sorted(folder.iterdir())
    meshes = [trimesh.load_mesh(path, process=False) for path in files]
    faces = np.asarray(meshes[0].faces)
    for path, mesh in zip(files, meshes, strict=True):
        if not np.array_equal(mesh.faces, faces):
            raise ValueError(f"data: expected the faces of {files[0].name} in {path}, got others.")
    return [np.asarray(mesh.vertices, dtype=np.float64) for mesh in meshes], faces


def transfer(
    rest: Floats, poses: Sequence[Floats], changed: Floats, faces: Integers
) -> list[Floats]:
    """Return the changed surface in each of the poses, by deformation transfer (Sumner and Popović 2004).

    Each edge of a changed face follows the deformation of the face from rest to the pose. Vertices are fitted to these
    edges by least squares with cotangent weights (Botsch, Sumner, Pauly and Gross 2006).

    Args:
        rest: (V, 3) vertices of the surface at rest.
        poses: (V, 3) vertices of the same surface in each pose.
        changed: (V, 3) vertices of the changed surface at rest.
        faces: (F, 3) indices of vertices.
    """
    n = len(rest)
    # Row 3 f + i subtracts the ends of the edge of face f that is opposite its corner i.
    starts = np.roll(faces, 1, axis=1).ravel()
    ends = np.roll(faces, -1, axis=1).ravel()
    rows = np.tile(np.arange(faces.size), 2)
    columns = np.concatenate([starts, ends])
    signs = np.repeat([1.0, -1.0], faces.size)
    differences = scipy.sparse.csr_array((signs, (rows, columns)), (faces.size, n))
    edges = (differences @ changed).reshape(-1, 3, 3)
    nexts = np.roll(edges, -1, axis=1)
    lasts = np.roll(edges, 1, axis=1)
    cosines = -(nexts * lasts).sum(axis=2)
    cotangents = cosines / np.linalg.norm(np.cross(nexts, lasts), axis=2)
    weighted = differences.T @ scipy.sparse.diags_array(cotangents.ravel())
    # Edges leave a translation open, so that the first vertex is held.
    fixed = scipy.sparse.csr_array(([1.0], ([0], [0])), (n, n))
    solver = splu((weighted @ differences + fixed).tocsc())
    to_rest = np.linalg.inv(frames(rest, faces))
    moved = []
    for pose in poses:
        deformation = frames(pose, faces) @ to_rest
        deformed = edges @ deformation.transpose(0, 2, 1)
        moved.append(solver.solve(weighted @ deformed.reshape(-1, 3)))
    return moved


def frames(vertices: Floats, faces: Integers) -> Floats:
    """Return matrices (F, 3, 3) whose columns are two edges and the unit normal of a face."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.stack([b - a, c - a, normals], axis=2)


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(people)
