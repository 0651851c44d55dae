"""Power of the tests of groups for small differences in one proportion, compared with ShapeDNA of LaPy."""

from collections.abc import Mapping, Sequence
from functools import reduce
from itertools import product
from operator import or_
from pathlib import Path
from typing import Any

import numpy as np

from igps._arrays import Floats, Integers
from igps.analysis.groups import group_test
from igps.data.collation import collate
from igps.descriptors import descriptor as descriptor_of
from igps.mesh.mesh import Mesh
from igps.report.answers import write_analysis
from igps.signature.signature import SignatureConfig, compute_signature

PROPORTIONS = ("width", "depth", "height", "waist")
_SCATTER = 0.02  # standard deviation of each proportion, as a share of its mean
_N_EIGENVALUES = 30
_LAPY = "ShapeDNA (LaPy)"


def power(
    out: Path = Path("build/power"),
    descriptors: Sequence[str] = ("pretrained", "rich", "interior", "shape_dna"),
    differences: Sequence[float] = (0.01, 0.02, 0.03),
    n_pool: int = 600,
    n_each: int = 30,
    n_draws: int = 400,
    seed: int = 0,
) -> None:
    """Print the share of draws in which the tests reject at 5 %.

    Subjects are eggs with a waist. Their width, depth, height and waist each have a standard deviation of 2 %. Two
    groups differ in the mean of one of these proportions, or in none. ShapeDNA is LaPy's spectrum of the same surfaces,
    divided by the first eigenvalue, which removes the size.

    Args:
        out: folder for power.csv and power.json.
        descriptors: names of descriptors.
        differences: differences between the means of a proportion, as shares.
        n_pool: subjects in the pool of each mean; groups without a difference are drawn from two pools, too.
        n_each: subjects of a group. Draws share no subjects until the pools are exhausted and shuffled again.
        n_draws: draws of two groups, for each difference.
        seed: seed of subjects and draws.
    """
    first = pool(PROPORTIONS[0], 0, n_pool, descriptors, np.random.default_rng([seed, 0]))
    rows: list[dict[str, Any]] = []
    compared = [(PROPORTIONS[0], 0.0), *product(PROPORTIONS, differences)]
    for number, (proportion, difference) in enumerate(compared, start=1):
        second = pool(
            proportion, difference, n_pool, descriptors, np.random.default_rng([seed, number])
        )
        setting = {"proportion": proportion if difference else "none", "difference": difference}
        print(setting, flush=True)
        rows += [{**setting, **row} for row in shares(first, second, n_each, n_draws, seed)]
    write_analysis(out, "power", rows)


def shares(
    first: Mapping[str, Floats], second: Mapping[str, Floats], n_each: int, n_draws: int, seed: int
) -> list[dict[str, Any]]:
    """Return, by descriptor, the shares of draws from two pools of vectors in which each test rejects."""
    rows: list[dict[str, Any]] = []
    for name in first:
        random, orders = np.random.default_rng(seed), list[list[Integers]]()
        while len(orders) < n_draws:
            shuffled = [random.permutation(len(side[name])) for side in (first, second)]
            n_groups = min(map(len, shuffled)) // n_each
            orders += [
                [order[i * n_each : (i + 1) * n_each] for order in shuffled]
                for i in range(n_groups)
            ]
        tests = [
            group_test(
                np.vstack([first[name][a], second[name][b]]),
                ["a"] * n_each + ["b"] * n_each,
                n_permutations=199,
                n_bootstraps=0,
                n_repeats=0,
                seed=draw,
            )
            for draw, (a, b) in enumerate(orders[:n_draws])
        ]
        rejected = {
            name_of_test: float(
                np.mean([getattr(test, f"{name_of_test}_p") <= 0.05 for test in tests])
            )
            for name_of_test in ("permanova", "kernel")
        }
        rows.append({"descriptor": name, **rejected})
        print(rows[-1], flush=True)
    return rows


def pool(
    proportion: str,
    difference: float,
    n_pool: int,
    descriptors: Sequence[str],
    random: np.random.Generator,
) -> dict[str, Floats]:
    """Draw subjects, and return their vectors (n_pool, D) by descriptor, including ShapeDNA of LaPy."""
    from lapy import TriaMesh, shapedna  # the extra `studies`

    chosen = [descriptor_of(name) for name in descriptors]
    config = reduce(or_, [x.requirements for x in chosen]).apply_to(SignatureConfig())
    vectors: dict[str, list[Floats]] = {name: [] for name in (*descriptors, _LAPY)}
    for _ in range(n_pool):
        mesh = subject(proportion, difference, random)
        batch = collate([compute_signature(mesh, config)])
        for name, descriptor in zip(descriptors, chosen, strict=True):
            coordinates = descriptor.coordinates(descriptor(batch).detach(), within_class=True)
            vectors[name].append(coordinates[0].double().numpy())
        values = shapedna.compute_shapedna(TriaMesh(mesh.vertices, mesh.faces), k=_N_EIGENVALUES)[
            "Eigenvalues"
        ][1:]
        vectors[_LAPY].append(np.log(values / values[0])[1:])
    return {name: np.array(rows) for name, rows in vectors.items()}


def subject(proportion: str, difference: float, random: np.random.Generator) -> Mesh:
    """Draw a subject of a group in which the mean of one proportion is larger by a share."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3)
    shift = difference * np.eye(len(PROPORTIONS))[PROPORTIONS.index(proportion)]
    width, depth, height, waist = 1 + shift + _SCATTER * random.normal(size=len(PROPORTIONS))
    x, y, z = ball.vertices.T
    narrow = 1 - 0.35 * waist * np.exp(-8 * (z - 0.1) ** 2)
    vertices = np.stack(
        [0.8 * width * narrow * x, 0.6 * depth * narrow * y, 1.6 * height * z], axis=1
    )
    return Mesh(vertices, ball.faces)
