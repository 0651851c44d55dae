"""How small a difference in one proportion the tests of groups find, beside the spectra of LaPy's ShapeDNA."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from igps.analysis.groups import group_test, vectors_of
from igps.data.collation import collate
from igps.descriptors import descriptor as descriptor_of
from igps.mesh.mesh import Mesh
from igps.report.answers import write_answer
from igps.signature.signature import SignatureConfig, compute_signature

# Of each proportion of a subject, as a share
_SCATTER = 0.02
_N_EIGENVALUES = 30


def power(
    out: Path = Path("build/power"),
    descriptor: str = "interior",
    differences: Sequence[float] = (0.0, 0.01, 0.02, 0.03),
    n_pool: int = 60,
    n_each: int = 30,
    n_draws: int = 200,
    seed: int = 0,
) -> None:
    """The share of draws in which PERMANOVA rejects at 5 %.

    Subjects are eggs with a waist, whose height, width, depth and waist each scatter by 2 %. Groups differ in the mean
    height. The spectrum is LaPy's, of the same surfaces, divided by the first eigenvalue, the size.

    Args:
        out: folder for power.csv and power.json.
        descriptor: a name.
        differences: of the mean height, as shares.
        n_pool: subjects of each mean that draws choose from.
        n_each: of a group in a draw.
        n_draws: of two groups.
        seed: of all.
    """
    from lapy import TriaMesh, shapedna  # the extra `studies`

    random, chosen = np.random.default_rng(seed), descriptor_of(descriptor)
    config = chosen.requirements.apply_to(SignatureConfig())
    vectors: dict[float, dict[str, list[NDArray[np.float64]]]] = {}
    # The groups without a difference are two as well
    for number, difference in enumerate((0.0, *differences)):
        found = vectors.setdefault(-1.0 if number == 0 else difference, {descriptor: [], "ShapeDNA (LaPy)": []})
        for _ in range(n_pool):
            mesh = subject(difference, random)
            description = chosen(collate([compute_signature(mesh, config)])).detach()
            found[descriptor].append(vectors_of(chosen, description)[0])
            surface = TriaMesh(mesh.vertices, mesh.faces)
            values = shapedna.compute_shapedna(surface, k=_N_EIGENVALUES)["Eigenvalues"][1:]
            found["ShapeDNA (LaPy)"].append(np.log(values / values[0])[1:])
    rows: list[dict[str, Any]] = []
    for difference in differences:
        for name in vectors[difference]:
            rejected = []
            for draw in range(n_draws):
                sides = [random.choice(len(vectors[of][name]), n_each, replace=False) for of in (-1.0, difference)]
                both = [vectors[of][name][i] for of, side in zip((-1.0, difference), sides, strict=True) for i in side]
                test = group_test(
                    np.array(both), ["a"] * n_each + ["b"] * n_each,
                    n_permutations=199, n_bootstraps=0, n_repeats=0, seed=draw,
                )  # fmt: skip
                rejected.append((test.permanova_p or 1) <= 0.05)
            rows.append({"descriptor": name, "difference": difference, "power": float(np.mean(rejected))})
            print(rows[-1], flush=True)
    write_answer(out, "power", rows)


def subject(difference: float, random: np.random.Generator) -> Mesh:
    """One of a group whose mean height is larger by a share."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3)
    width, depth, height, waist = 1 + _SCATTER * random.normal(size=4)
    x, y, z = ball.vertices.T
    narrow = 1 - 0.35 * waist * np.exp(-8 * (z - 0.1) ** 2)
    vertices = np.stack([0.8 * width * narrow * x, 0.6 * depth * narrow * y, 1.6 * (height + difference) * z], axis=1)
    return Mesh(vertices, ball.faces)
