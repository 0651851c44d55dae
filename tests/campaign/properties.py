"""Invariances of all named descriptors, tested on bodies and changes that hypothesis chooses.

A movement is the distance between the descriptions of a body before and after a change, by the descriptor's distance,
in percent of the median distance between different bodies.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
import trimesh
from hypothesis import HealthCheck, Phase, given, seed, settings, target
from hypothesis import strategies as st
from numpy.random import default_rng
from outcome import Row
from scipy.spatial.transform import Rotation

from igps import Mesh, SignatureConfig, collate, compute_signature, descriptor
from igps.data.requirements import Requirements
from igps.descriptors import NAMES
from igps.nn.descriptor import Descriptor, EmbeddedDescriptor
from igps.retrieval import cosine
from igps.signature.signature import Samples

SEED = 13

# Largest movements of a description, in percent of the median distance between bodies
EXACT = 0.1  # for rounding errors of single precision, and of values at the edges of bins
DISCRETE = 10.0  # for the same body on another grid or mesh: small compared with the distance between bodies
_PROMISES = {
    "motion": "nothing but rounding, but for the grid and the rays of a reflection",
    "turned grid": "a turn that takes the axes of the grid to each other: nothing but rounding",
    "scale": "nothing but rounding",
    "renumbering of vertices": "nothing but rounding",
    "renumbering of faces": "nothing but rounding",
    "subdivision": "the same surface with four times the faces: another operator",
    "signs and bases": "signs, and a basis inside each multiplet: nothing but rounding",
    "padding": "nothing at all",
    "batch size": "nothing at all",
    "threads": "nothing at all",
}
# A motion moves the body relative to the grid of its samples, at which thickness is measured, too. A reflection
# exchanges the corners of faces, which determine the directions of rays.
_GRID = {
    "interior",
    "multiscale",
    "rich",
    "pretrained",
    "inner_distance",
    "volume_shape_dna",
    "measures",
}
_RAYS = {"local_diameter_centricity"}


@dataclass(frozen=True)
class Bound:
    """Bound of the movement of a description.

    Args:
        percent: of the median distance between bodies.
        known: the reason for a larger movement, if it is known; such a movement is reported, and is not a miss.
    """

    percent: float
    known: str = ""


# Known movements above the bound, and their reasons
KNOWN = {
    # The worst body moves by 14 % from one subdivision to two, and by 2 % from two to three.
    (
        "subdivision",
        "gps",
    ): "one subdivision has too few vertices for the last of its 250 eigenpairs",
}


def bound(prop, name):
    """Bound for a property and a descriptor."""
    exact = prop != "subdivision" and not (prop == "motion" and name in _GRID | _RAYS)
    return Bound(EXACT if exact else DISCRETE, KNOWN.get((prop, name), ""))


# The default number of surface samples: with fewer random samples, descriptions of a body would differ.
CONFIG = SignatureConfig(resolution=20, min_samples=0)


@cache
def bodies():
    """Bodies of three to six hundred vertices, of genus 0 and 1, none symmetric, that all descriptors can describe."""
    box = trimesh.creation.box(extents=(1.0, 0.8, 0.5))
    for _ in range(3):
        box = box.subdivide()
    surfaces = [
        trimesh.creation.icosphere(subdivisions=3),
        trimesh.creation.torus(1.0, 0.4, major_sections=30, minor_sections=14),
        trimesh.creation.icosphere(subdivisions=3).apply_scale([0.5, 0.6, 2.0]),
        box,
    ]
    meshes = []
    for number, surface in enumerate(surfaces):
        surface.merge_vertices()
        x, y, z = np.asarray(surface.vertices).T
        bent = np.stack(
            [
                1.2 * x + 0.15 * y * z,
                y + 0.2 * x * x + 0.07 * z,
                0.9 * z + 0.15 * np.sin(2 * x + number),
            ],
            1,
        )
        meshes.append(Mesh(bent, np.asarray(surface.faces), name=f"body {number}"))
    return tuple(meshes)


@cache
def _subdivided(number, n_times):
    """A body after subdivision of each face into four, repeated `n_times`."""
    mesh = bodies()[number]
    for _ in range(n_times):
        vertices, faces = trimesh.remesh.subdivide(mesh.vertices, mesh.faces)
        mesh = replace(mesh, vertices=vertices, faces=faces)
    return mesh


def _distance(module):
    """Distance of a descriptor; the cosine distance for embeddings, as a head's distance may ignore small movements."""
    return cosine if isinstance(module, EmbeddedDescriptor) else module.distances


class Describer:
    """Descriptions by every descriptor, and the scale of their distances."""

    def __init__(self, names=NAMES):
        self.descriptors: dict[str, Descriptor] = {name: descriptor(name) for name in names}
        requirements = Requirements()
        for module in self.descriptors.values():
            requirements = requirements | module.requirements
        self.config = requirements.apply_to(CONFIG)
        self.signatures = [compute_signature(mesh, self.config) for mesh in bodies()]
        self.unchanged = [
            self.describe(s, m) for s, m in zip(self.signatures, bodies(), strict=True)
        ]
        self.median = {}
        for name, module in self.descriptors.items():
            descriptions = torch.cat([description[name] for description in self.unchanged])
            distances = _distance(module)(descriptions, descriptions)
            self.median[name] = float(
                distances[~torch.eye(len(descriptions), dtype=torch.bool)].median()
            )

    def describe(self, signature, mesh, names=None):
        """Description (1, ...) by each descriptor, or by some of them."""
        batch = collate([signature], [mesh])
        with torch.inference_mode():
            return {
                name: self.descriptors[name](batch)
                for name in (self.descriptors if names is None else names)
            }

    @cache  # noqa: B019 (there is one describer in a campaign)
    def describe_subdivided(self, number, n_times):
        """Descriptions of a body after subdivision of each face into four, repeated `n_times`."""
        mesh = _subdivided(number, n_times)
        return self.describe(compute_signature(mesh, self.config), mesh)

    def simplifying(self, mesh):
        """Names of the descriptors that simplify a mesh first."""
        limits = {
            name: getattr(module, "max_vertices", None) for name, module in self.descriptors.items()
        }
        return [
            name
            for name, limit in limits.items()
            if limit is not None and limit < len(mesh.vertices)
        ]

    def movements(self, before, after):
        """Movement by each descriptor, in percent of the median distance."""
        return {
            name: 100
            * float(_distance(self.descriptors[name])(before[name], value))
            / self.median[name]
            for name, value in after.items()
        }


# Descriptions before and after a change
Pair = tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]
Change = Callable[[Describer, st.DataObject], Pair]

_numbers = st.integers(0, len(bodies()) - 1)
_seeds = st.integers(0, 2**32 - 1)


def _moved_mesh(describer, number, mesh):
    return describer.unchanged[number], describer.describe(
        compute_signature(mesh, describer.config), mesh
    )


def _motion(describer, data):
    """A rotation and a shift, with or without a reflection."""
    number = data.draw(_numbers)
    generator = default_rng(data.draw(_seeds))
    turn = Rotation.from_quat(generator.normal(size=4)).as_matrix() * data.draw(
        st.sampled_from([1.0, -1.0])
    )
    mesh = bodies()[number]
    faces = mesh.faces if np.linalg.det(turn) > 0 else mesh.faces[:, ::-1]
    moved = replace(
        mesh,
        vertices=mesh.vertices @ turn.T + generator.normal(size=3),
        faces=faces,
    )
    return _moved_mesh(describer, number, moved)


def _turned_grid(describer, data):
    """A rotation of the cube, which keeps the order of faces and corners."""
    number = data.draw(_numbers)
    order = data.draw(st.permutations(range(3)))
    signs = np.array(data.draw(st.tuples(*[st.sampled_from([-1.0, 1.0])] * 3)))
    signs[0] *= np.linalg.det(np.eye(3)[order] * signs)
    mesh = bodies()[number]
    return _moved_mesh(
        describer,
        number,
        replace(mesh, vertices=mesh.vertices[:, order] * signs),
    )


def _scale(describer, data):
    number = data.draw(_numbers)
    mesh = bodies()[number]
    return _moved_mesh(
        describer,
        number,
        replace(
            mesh,
            vertices=mesh.vertices * 10 ** data.draw(st.floats(-12, 12)),
        ),
    )


def _vertices(describer, data):
    number = data.draw(_numbers)
    return _moved_mesh(describer, number, _renumbered(bodies()[number], data.draw(_seeds)))


def _many_vertices(describer, data):
    """A renumbering of large meshes, for descriptors that simplify them before they choose samples."""
    number = data.draw(_numbers)
    mesh = _renumbered(_subdivided(number, 1), data.draw(_seeds))
    after = describer.describe(
        compute_signature(mesh, describer.config), mesh, describer.simplifying(mesh)
    )
    return describer.describe_subdivided(number, 1), after


def _renumbered(mesh, seed):
    order = default_rng(seed).permutation(len(mesh.vertices))
    return replace(
        mesh,
        vertices=mesh.vertices[order],
        faces=np.argsort(order)[mesh.faces],
    )


def _faces(describer, data):
    number = data.draw(_numbers)
    mesh = bodies()[number]
    generator = default_rng(data.draw(_seeds))
    faces = mesh.faces[generator.permutation(len(mesh.faces))]
    start = generator.integers(3, size=(len(faces), 1))
    turned = np.take_along_axis(
        faces,
        (start + np.arange(3)) % 3,
        axis=1,
    )
    return _moved_mesh(describer, number, replace(mesh, faces=turned))


def _subdivision(describer, data):
    """From one subdivision to two. The original meshes are too coarse for 250 meaningful eigenpairs."""
    number = data.draw(_numbers)
    return describer.describe_subdivided(number, 1), describer.describe_subdivided(number, 2)


def _signs(describer, data):
    """Random signs of all eigenfunctions."""
    number = data.draw(_numbers)
    generator = default_rng(data.draw(_seeds))
    signature = describer.signatures[number]
    n_eigenpairs = len(signature.eigenvalues)
    basis = np.diag(generator.choice([-1.0, 1.0], n_eigenpairs))
    after = describer.describe(_in_basis(signature, basis, signature.eigenvalues), bodies()[number])
    return describer.unchanged[number], after


def _multiplet(describer, data):
    """A random basis of a multiplet. Neighbouring eigenvalues are averaged before and after the change to make one."""
    number = data.draw(_numbers)
    generator = default_rng(data.draw(_seeds))
    signature = describer.signatures[number]
    n_eigenpairs = len(signature.eigenvalues)
    # No descriptor splits one of these multiplets: they use the first 4, 8, 12, 16, 50 and 250 eigenpairs.
    first = int(generator.choice([0, 5, 9, 13, 20, 60, 150]))
    size = int(generator.choice([2, 3]))
    values = signature.eigenvalues.copy()
    values[first : first + size] = values[first : first + size].mean()
    basis = np.eye(n_eigenpairs)
    basis[first : first + size, first : first + size] = np.linalg.qr(
        generator.normal(size=(size, size))
    )[0]
    degenerate = describer.describe(
        _in_basis(signature, np.eye(n_eigenpairs), values), bodies()[number]
    )
    turned = describer.describe(_in_basis(signature, basis, values), bodies()[number])
    return degenerate, turned


def _in_basis(signature, basis, values):
    def turned(samples):
        return replace(
            samples,
            eigenfunctions=(samples.eigenfunctions.astype(np.float64) @ basis).astype(np.float32),
        )

    return replace(
        signature,
        eigenvalues=values,
        interior=turned(signature.interior),
        surface=turned(signature.surface),
    )


def _padding(describer, data):
    """A batch with a body of more samples and more eigenpairs, in any order."""
    number = data.draw(_numbers)
    other = data.draw(_numbers)
    repeated = describer.signatures[other]

    def longer(samples):
        def twice(values):
            return np.concatenate([values, values])

        attributes = {name: twice(values) for name, values in samples.attributes.items()}
        functions = np.concatenate(
            [samples.eigenfunctions, samples.eigenfunctions[:, -5:]],
            axis=1,
        )
        return Samples(twice(samples.points), twice(functions), attributes)

    larger = replace(
        repeated,
        eigenvalues=np.append(
            repeated.eigenvalues, repeated.eigenvalues[-1] * (1 + np.arange(1, 6) / 100)
        ),
        interior=longer(repeated.interior),
        surface=longer(repeated.surface),
    )
    place = data.draw(st.integers(0, 1))
    pair = [
        (describer.signatures[number], bodies()[number]),
        (larger, bodies()[other]),
    ]
    batch = collate(
        *zip(
            *(pair if place == 0 else pair[::-1]),
            strict=True,
        )
    )
    with torch.inference_mode():
        after = {name: module(batch)[[place]] for name, module in describer.descriptors.items()}
    return describer.unchanged[number], after


def _batch_size(describer, data):
    numbers = data.draw(st.lists(_numbers, min_size=2, max_size=3))
    batch = collate(
        [describer.signatures[i] for i in numbers],
        [bodies()[i] for i in numbers],
    )
    with torch.inference_mode():
        after = {name: module(batch)[[-1]] for name, module in describer.descriptors.items()}
    return describer.unchanged[numbers[-1]], after


def _threads(describer, data):
    number = data.draw(_numbers)
    before = torch.get_num_threads()
    torch.set_num_threads(data.draw(st.integers(2, 4)))
    try:
        mesh = bodies()[number]
        return _moved_mesh(describer, number, mesh)
    finally:
        torch.set_num_threads(before)


CHANGES = {
    "motion": (_motion,),
    "turned grid": (_turned_grid,),
    "scale": (_scale,),
    "renumbering of vertices": (_vertices, _many_vertices),
    "renumbering of faces": (_faces,),
    "subdivision": (_subdivision,),
    "signs and bases": (_signs, _multiplet),
    "padding": (_padding,),
    "batch size": (_batch_size,),
    "threads": (_threads,),
}


def campaign(n_examples, names=NAMES):
    """Try `n_examples` examples of each change."""
    torch.set_num_threads(1)
    describer = Describer(names)
    return [_row(describer, prop, changes, n_examples) for prop, changes in CHANGES.items()]


def _row(describer, prop, changes, n_examples):
    start = time.monotonic()
    largest = dict.fromkeys(describer.descriptors, 0.0)
    tried = 0

    def example(data):
        nonlocal tried
        for change in changes:
            tried += 1
            movements = describer.movements(*change(describer, data))
            for name, movement in movements.items():
                largest[name] = max(
                    largest[name],
                    movement if np.isfinite(movement) else np.inf,
                )
            # Hypothesis searches for the largest movement relative to its bound.
            shares = [
                min(movement, 1e6) / bound(prop, name).percent
                for name, movement in movements.items()
            ]
            target(max(shares, default=0.0), label=change.__name__)

    run = given(st.data())(example)
    run = seed(SEED)(run)
    run = settings(
        max_examples=n_examples,
        database=None,
        deadline=None,
        phases=[Phase.generate, Phase.target],
        suppress_health_check=list(HealthCheck),
    )(run)
    run()
    missed = []
    notes = []
    for name, movement in largest.items():
        limit = bound(prop, name)
        if movement > limit.percent:
            sentence = f"{name} moves by {movement:.3g} %, {limit.percent:g} % allowed"
            if limit.known:
                notes.append(f"{sentence}: {limit.known}")
            else:
                missed.append(sentence)
    worst = max(
        largest,
        key=lambda name: largest[name] / bound(prop, name).percent,
    )
    return Row(
        "properties",
        prop,
        tried,
        _PROMISES[prop],
        f"at most {largest[worst]:.2g} % ({worst})",
        missed,
        notes,
        details={
            name: {"percent": movement, "allowed": bound(prop, name).percent}
            for name, movement in largest.items()
        },
        seconds=time.monotonic() - start,
    )
