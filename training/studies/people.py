"""How well descriptors tell individuals apart that have the poses of one scanned body."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.sparse
import trimesh
from scipy.sparse.linalg import splu

import igps
from igps._arrays import Floats, Integers
from igps.nn.description import describe
from igps.retrieval import retrieval_scores
from training.graded.individuals import Change
from training.studies.generated import usable_shapes

_SHARES = (
    0.04,
    0.1,
)  # largest displacements of an individual from the scanned body, in units of √area


def people(
    data: Path,
    root: Path = Path("build/people"),
    descriptors: Sequence[str] = (
        "interior",
        "gps",
        "shape_dna",
        "multiscale",
        "rich",
        "pretrained",
    ),
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
        cache_dir: folder of cached signatures; the user's cache directory if not given.
        n_workers: processes; all cores if not given.

    Raises:
        ValueError: a mesh has other faces than the first mesh of its folder.
    """
    for number, folder in enumerate(sorted(path for path in data.iterdir() if path.is_dir())):
        files = sorted(folder.iterdir())
        poses = [trimesh.load_mesh(path, process=False) for path in files]
        faces, random = np.asarray(poses[0].faces), np.random.default_rng([seed, number])
        for path, scan in zip(files, poses, strict=True):
            if not np.array_equal(scan.faces, faces):
                raise ValueError(
                    f"data: expected the faces of {files[0].name} in {path}, got others."
                )
        vertices = [np.asarray(pose.vertices, dtype=np.float64) for pose in poses]
        for individual in range(n_individuals):
            change = Change.draw(random, vertices[0], faces, _SHARES)
            target = root / folder.name / str(individual)
            target.mkdir(parents=True, exist_ok=True)
            for pose, moved in enumerate(
                transfer(vertices[0], vertices, change(vertices[0]), faces)
            ):
                trimesh.Trimesh(moved, faces, process=False).export(target / f"{pose}.off")
        for name in descriptors:
            descriptor = igps.descriptor(name)
            shapes = usable_shapes(root / folder.name, descriptor, cache_dir, n_workers)
            described = describe(shapes, descriptor, n_workers=n_workers)
            scores = retrieval_scores(
                descriptor.distances(described, described), shapes.labels
            ).mean()
            print(
                f"{folder.name} {name}: NN {100 * scores['nn']:.1f} FT {100 * scores['ft']:.1f}",
                flush=True,
            )


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
    # Row 3 f + i subtracts the ends of the edge of face f that is opposite its corner i.
    corners = [np.roll(faces, shift, axis=1).ravel() for shift in (1, -1)]
    rows, signs = np.tile(np.arange(faces.size), 2), np.repeat([1.0, -1.0], faces.size)
    differences = scipy.sparse.csr_array(
        (signs, (rows, np.concatenate(corners))), (faces.size, len(rest))
    )
    edges = (differences @ changed).reshape(-1, 3, 3)
    nexts, lasts = np.roll(edges, -1, axis=1), np.roll(edges, 1, axis=1)
    cotangents = -(nexts * lasts).sum(axis=2) / np.linalg.norm(np.cross(nexts, lasts), axis=2)
    weighted = differences.T @ scipy.sparse.diags_array(cotangents.ravel())
    fixed = scipy.sparse.csr_array(
        ([1.0], ([0], [0])), (len(rest), len(rest))
    )  # edges leave a translation open
    solver = splu((weighted @ differences + fixed).tocsc())
    to_rest = np.linalg.inv(_frames(rest, faces))
    moved = []
    for pose in poses:
        deformed = edges @ (_frames(pose, faces) @ to_rest).transpose(0, 2, 1)
        moved.append(solver.solve(weighted @ deformed.reshape(-1, 3)))
    return moved


def _frames(vertices: Floats, faces: Integers) -> Floats:
    """(F, 3, 3) matrices whose columns are two edges and the unit normal of a face."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.stack([b - a, c - a, normals], axis=2)
