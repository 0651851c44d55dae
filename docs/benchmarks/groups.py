"""How small a difference between groups is found, compared with ShapeDNA of LaPy: the table of how-to/groups.md.

python -m docs.benchmarks.groups
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from itertools import product
from operator import or_
from typing import Any

import numpy as np
from jsonargparse import auto_cli

from igps._arrays import Floats, Integers
from igps.analysis.groups import group_test
from igps.cli import errors_as_messages
from igps.data.collation import collate
from igps.descriptors import descriptor as descriptor_of
from igps.mesh.mesh import Mesh
from igps.signature.signature import SignatureConfig, compute_signature

PROPORTIONS = ("width", "depth", "height", "waist")
SCATTER = 0.02  # standard deviation of each proportion, as a share of its mean
N_EIGENVALUES = 30
LAPY = "ShapeDNA (LaPy)"
LEVEL = 0.05


def power(
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
        descriptors: names of descriptors.
        differences: differences between the means of a proportion, as shares.
        n_pool: subjects in the pool of each mean; groups without a difference are drawn from two pools, too.
        n_each: subjects of a group. Draws share no subjects until the pools are exhausted and shuffled again.
        n_draws: draws of two groups, for each difference.
        seed: seed of subjects and draws.
    """
    first = pool(PROPORTIONS[0], 0, n_pool, descriptors, np.random.default_rng([seed, 0]))
    compared = [(PROPORTIONS[0], 0.0), *product(PROPORTIONS, differences)]
    for number, (proportion, difference) in enumerate(compared, start=1):
        generator = np.random.default_rng([seed, number])
        second = pool(proportion, difference, n_pool, descriptors, generator)
        print(f"{proportion} larger by {difference:.0%}", flush=True)
        for row in shares(first, second, n_each, n_draws, seed):
            print(f"  {row}", flush=True)


def shares(
    first: Mapping[str, Floats], second: Mapping[str, Floats], n_each: int, n_draws: int, seed: int
) -> list[dict[str, Any]]:
    """Return, by descriptor, the shares of draws from two pools of vectors in which each test rejects."""
    rows = []
    for name in first:
        draws = draw_groups(len(first[name]), len(second[name]), n_each, n_draws, seed)
        tests = []
        for number, (a, b) in enumerate(draws):
            vectors = np.vstack([first[name][a], second[name][b]])
            groups = ["a"] * n_each + ["b"] * n_each
            tests.append(
                group_test(
                    vectors, groups, n_permutations=199, n_bootstraps=0, n_repeats=0, seed=number
                )
            )
        permanova = np.mean([test.permanova_p <= LEVEL for test in tests])
        kernel = np.mean([test.kernel_p <= LEVEL for test in tests])
        rows.append({"descriptor": name, "permanova": float(permanova), "kernel": float(kernel)})
    return rows


def draw_groups(
    n_first: int, n_second: int, n_each: int, n_draws: int, seed: int
) -> list[tuple[Integers, Integers]]:
    """Draw two groups repeatedly from two pools, without a subject twice until a pool is exhausted."""
    random = np.random.default_rng(seed)
    draws: list[tuple[Integers, Integers]] = []
    while len(draws) < n_draws:
        a = random.permutation(n_first)
        b = random.permutation(n_second)
        for start in range(0, min(n_first, n_second) - n_each + 1, n_each):
            draws.append((a[start : start + n_each], b[start : start + n_each]))
    return draws[:n_draws]


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
    vectors: dict[str, list[Floats]] = {name: [] for name in (*descriptors, LAPY)}
    for _ in range(n_pool):
        mesh = subject(proportion, difference, random)
        batch = collate([compute_signature(mesh, config)])
        for name, descriptor in zip(descriptors, chosen, strict=True):
            coordinates = descriptor.coordinates(descriptor(batch).detach(), within_class=True)
            vectors[name].append(coordinates[0].double().numpy())
        surface = TriaMesh(mesh.vertices, mesh.faces)
        spectrum = shapedna.compute_shapedna(surface, k=N_EIGENVALUES)
        values = spectrum["Eigenvalues"][1:]
        vectors[LAPY].append(np.log(values / values[0])[1:])
    return {name: np.array(rows) for name, rows in vectors.items()}


def subject(proportion: str, difference: float, random: np.random.Generator) -> Mesh:
    """Draw a subject of a group in which the mean of one proportion is larger by a share."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3)
    shift = difference * np.eye(len(PROPORTIONS))[PROPORTIONS.index(proportion)]
    width, depth, height, waist = 1 + shift + SCATTER * random.normal(size=len(PROPORTIONS))
    x, y, z = ball.vertices.T
    narrow = 1 - 0.35 * waist * np.exp(-8 * (z - 0.1) ** 2)
    axes = [0.8 * width * narrow * x, 0.6 * depth * narrow * y, 1.6 * height * z]
    return Mesh(np.stack(axes, axis=1), ball.faces)


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(power)
