"""Where on a body two groups differ: how far the surfaces of one group lie outside those of the other."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from igps._arrays import Booleans, Floats
from igps._parallel import run
from igps._parameters import check_at_least, check_fraction
from igps._progress import Progress
from igps._threads import one_thread
from igps.analysis.alignment import rigid_motion
from igps.analysis.groups import codes_of, design_of, permutations
from igps.data.pipeline import SignaturePipeline
from igps.failures import Failed
from igps.mesh.loading import BodyRef
from igps.mesh.mesh import Mesh, millimetres
from igps.mesh.surface import vertex_areas

if TYPE_CHECKING:
    # Loads torch, which workers do without
    from igps.data.dataset import SignatureDataset

_MIN_SCALE = 1e-9  # of the scatter at a vertex, over the largest; with less nothing varies there


@dataclass(frozen=True, eq=False)
class LocalDifference:
    """The difference of two groups at the vertices of a body."""

    groups: tuple[str, str]
    offset: Floats  # (V,) mean of the second group less that of the first, outward, in the body's unit of length
    is_significant: Booleans  # (V,)


def offsets(body: Mesh, reference: Mesh, *, keep_size: bool = True) -> Floats:
    """Return how far the surface of a body lies outside that of another.

    The body is laid onto the reference, see `rigid_motion`; unless its size is kept, it is scaled to the volume of the
    reference.

    Returns:
        (V,) the distance of each vertex of the reference from the surface of the body, in the unit of the reference,
        positive where the vertex is inside the body.
    """
    import igl

    scale = millimetres(body.unit) / millimetres(reference.unit)
    if not keep_size:
        scale = float(np.cbrt(reference.volume / body.volume))
    motion = rigid_motion(body, reference, scale=scale)
    points = np.ascontiguousarray(motion.back(reference.vertices))
    kind = igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    outside, *_ = igl.signed_distance(points, body.vertices, body.faces, kind)
    return np.asarray(-scale * outside)


def offsets_of_bodies(
    dataset: SignatureDataset,
    members: Sequence[int],
    reference: Mesh,
    *,
    keep_size: bool = True,
    n_workers: int | None = None,
) -> Floats:
    """Return the offsets (N, V) of bodies of a dataset, see `offsets`; NaN for one whose mesh cannot be read again."""
    rows = np.full((len(members), len(reference.vertices)), np.nan)
    work = partial(_offsets_of_body, dataset.pipeline, reference, keep_size)
    bodies = [dataset.bodies[i] for i in members]
    with contextlib.closing(run(work, bodies, n_workers=n_workers)) as outcomes:
        for number, outcome in Progress(outcomes, total=len(bodies), desc="offsets"):
            if not isinstance(outcome, Failed):
                rows[number] = outcome
    return rows


def _offsets_of_body(
    pipeline: SignaturePipeline, reference: Mesh, keep_size: bool, body: BodyRef
) -> Floats:
    with one_thread():
        return offsets(pipeline.mesh(body), reference, keep_size=keep_size)


def local_difference(
    rows: Floats,
    groups: Sequence[str],
    *,
    strata: Sequence[str] | None = None,
    covariates: Floats | None = None,
    level: float = 0.05,
    n_permutations: int = 1000,
    seed: int = 0,
) -> LocalDifference:
    """Test where the offsets of two groups differ.

    This is a permutation test of the largest standardised difference (Westfall and Young 1993). Strata and covariates
    are regressed out, and the residuals permuted within strata, as in `group_test`.

    Args:
        rows: (N, V) offsets of each body, see `offsets`.
        groups: two different names, one for each body.
        strata, covariates: see `group_test`.
        level: family-wise error rate over all vertices.
        n_permutations: number of random permutations.
        seed: seed of the permutations.

    Raises:
        ValueError: other than two groups, or covariates or strata that determine them.
    """
    check_fraction(level=level)
    check_at_least(1, n_permutations=n_permutations)
    names = sorted(set(groups))
    if len(names) != 2:
        raise ValueError(f"groups: expected two, got {len(names)}: {', '.join(names)}.")
    n = len(rows)
    stratum = codes_of(["all"] * n if strata is None else strata)
    numbers = np.ones((n, 0)) if covariates is None else covariates
    group = codes_of(groups)
    design = design_of(group, stratum, numbers)
    if not design.added.shape[1]:
        raise ValueError("groups: covariates or strata determine them. Leave these out.")
    residuals = rows - design.nuisance @ (design.nuisance.T @ rows)
    contrast = design.added[:, 0]
    contrast = contrast * np.sign(contrast @ group)
    orders = permutations(stratum, n_permutations + 1, np.random.default_rng(seed))
    orders[0] = np.arange(n)
    scatter = np.linalg.norm(residuals, axis=0)
    varies = scatter > _MIN_SCALE * scatter.max(initial=0)
    divisors = np.where(varies, scatter, 1)
    standardised = np.where(varies, residuals / divisors, 0)
    differences = np.abs(contrast[orders] @ standardised)
    largest = differences.max(axis=1)
    offset = contrast @ residuals / (contrast @ group)
    is_significant = differences[0] > np.quantile(largest, 1 - level)
    return LocalDifference((names[0], names[1]), offset, is_significant)


def misfit(rows: Floats, reference: Mesh) -> float:
    """Return the median distance of bodies from the reference, over the square root of its area.

    Args:
        rows: (N, V) offsets of the bodies.
        reference: the body that they are laid on.
    """
    areas = vertex_areas(reference.vertices, reference.faces)
    distances = np.abs(rows) @ areas / areas.sum()
    return float(np.median(distances) / np.sqrt(reference.area))
