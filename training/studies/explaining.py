"""Localisation by explanations: pairs of generated poses of a body, one of them altered in one place."""

from collections.abc import Sequence
from functools import reduce
from itertools import product
from operator import or_
from pathlib import Path
from typing import Any

import numpy as np

from igps._arrays import Floats
from igps.analysis.explanation import explain, share_density
from igps.data.collation import collate
from igps.descriptors import descriptor as descriptor_of
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.mesh.surface import area_vectors
from igps.report.answers import write_analysis
from igps.signature.signature import SAMPLE_KINDS, SignatureConfig, compute_signature
from training.graded.shapes import GradedShapes

ALTERATIONS = ("bump", "dent", "limb", "hole")
# In units of √area: the smallest radius of an alteration, and the range of its size
_REACH, _SIZES = 0.1, (0.005, 0.05)


def explaining(
    out: Path = Path("build/explaining"),
    descriptors: Sequence[str] = ("interior", "rich", "pretrained"),
    n_bodies: int = 50,
    seed: int = 0,
) -> None:
    """Print the area under the ROC curve of the explained difference against the true place of the alteration.

    Args:
        out: folder for explaining.csv and explaining.json.
        descriptors: names of descriptors.
        n_bodies: number of bodies; each is altered in each way.
        seed: seed of the bodies and alterations.
    """
    from sklearn.metrics import roc_auc_score

    chosen = {name: descriptor_of(name) for name in descriptors}
    config = reduce(or_, (x.requirements for x in chosen.values())).apply_to(SignatureConfig())
    shapes, rows = GradedShapes(24, -(-n_bodies // 24), 2, seed=seed), list[dict[str, Any]]()
    random = np.random.default_rng(seed)
    places = random.permutation(len(shapes) // 2)[:n_bodies].tolist()
    for place, how in product(places, ALTERATIONS):
        size = float(np.exp(random.uniform(*np.log(_SIZES))))
        try:
            drawn = [shapes[2 * place + pose] for pose in (0, 1)]
            before, after = (Mesh(shape.vertices, shape.faces) for shape in drawn)
            altered, centre, reach = alter(after, how, size, random)
            signatures = [compute_signature(mesh, config) for mesh in (before, altered)]
        except (MeshError, ValueError) as error:
            print(f"{shapes.names[2 * place]}: {error}")
            continue
        samples = {kind: getattr(signatures[1], kind).points for kind in SAMPLE_KINDS}
        points = samples["surface"]
        true = np.linalg.norm(points - centre, axis=1) < reach
        if not 0 < true.sum() < len(true):
            continue
        batches = [collate([signature]) for signature in signatures]
        for name, descriptor in chosen.items():
            explanation = explain(descriptor, *batches)
            by_samples, by_place = (
                float(roc_auc_score(true, share_density(shares[1], samples, points)))
                for shares in (explanation.samples, explanation.places or explanation.samples)
            )
            rows.append(
                {
                    "body": drawn[1].name,
                    "alteration": how,
                    "size": round(size, 4),
                    "descriptor": name,
                    "distance": explanation.distance,
                    "auc": by_place,
                    "auc_of_pairs": by_samples,
                    "told": explanation.summary(),
                }
            )
            print(rows[-1], flush=True)
        write_analysis(out, "explaining", rows)
    for name in descriptors:
        for how in ("all", *ALTERATIONS):
            own = [
                row
                for row in rows
                if row["descriptor"] == name and how in ("all", row["alteration"])
            ]
            auc, auc_of_pairs = ([row[column] for row in own] for column in ("auc", "auc_of_pairs"))
            print(
                f"{name} {how}: {np.mean(auc):.3f} of {len(auc)}, by pairs alone {np.mean(auc_of_pairs):.3f}"
            )


def alter(
    mesh: Mesh, how: str, size: float, random: np.random.Generator
) -> tuple[Mesh, Floats, float]:
    """Alter a mesh in one place; return it with the centre and the radius of the place.

    Args:
        mesh: the body.
        how: one of the `ALTERATIONS`.
        size: how far the surface moves, or the radius of the hole, as a share of √area.
        random: draws the place.
    """
    vertices, unit = mesh.vertices, np.sqrt(mesh.area)
    away = np.linalg.norm(vertices - vertices.mean(axis=0), axis=1)
    tip = int(away.argmax()) if how == "limb" else int(random.integers(len(vertices)))
    centre, reach = vertices[tip], _REACH * unit
    vectors = area_vectors(vertices, mesh.faces)
    near = np.linalg.norm(vertices[mesh.faces].mean(axis=1) - centre, axis=1) < 0.5 * reach
    outward = (
        vectors[near].sum(axis=0)
        if near.any()
        else vectors[(mesh.faces == tip).any(axis=1)].sum(axis=0)
    )
    outward = outward / np.linalg.norm(outward)
    if how == "hole":
        import trimesh

        radius = size * unit
        rod = trimesh.creation.cylinder(radius, 2 * unit, transform=_along(outward, centre))
        cut = trimesh.boolean.difference(
            [trimesh.Trimesh(vertices, mesh.faces, process=False), rod], engine="manifold"
        )
        return Mesh(cut.vertices, cut.faces), centre, max(reach, 2 * radius)
    profile = np.clip(1 - (np.linalg.norm(vertices - centre, axis=1) / reach) ** 2, 0, 1) ** 2
    step = (-size if how == "dent" else size) * unit
    moved = vertices + profile[:, None] * step * outward
    return Mesh(moved, mesh.faces), centre + step * outward, reach


def _along(direction: Floats, centre: Floats) -> Floats:
    """Return the motion (4, 4) of the z axis to a direction through a centre."""
    import trimesh

    motion: Floats = trimesh.geometry.align_vectors([0, 0, 1], direction)
    motion[:3, 3] = centre
    return motion
