"""What all descriptors of the library promise, shown on a rod, the same rod changed, and another body."""

from __future__ import annotations

import pickle
import re
from collections import Counter
from dataclasses import replace
from functools import cache, reduce
from operator import or_

import numpy as np
import pytest
import torch
import trimesh
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

import igps
from batches import exported, tensors
from igps.data.batch import SignatureBatch
from igps.data.collation import collate
from igps.data.requirements import Requirements
from igps.descriptors import NAMES, descriptor
from igps.descriptors.registry import FIELD_NAMES
from igps.mesh.mesh import Mesh
from igps.nn.axes import Attribute
from igps.nn.descriptor import BodyDescriptor, EmbeddedDescriptor, HistogramDescriptor
from igps.nn.histograms import PairHistogram, PointHistogram
from igps.retrieval import cosine
from igps.signature.signature import Signature, SignatureConfig, compute_signature

ROTATION = trimesh.transformations.euler_matrix(0.4, 1.1, -0.7)[:3, :3]
ON_TENSORS = [name for name in NAMES if not isinstance(descriptor(name), BodyDescriptor)]
CHANGES = [(name, change) for name in NAMES for change in descriptor(name).invariant_to]


def rod():
    """Vertices of a rod along x, thicker at one end: the faces are those of `unit_sphere`."""
    x, y, z = unit_sphere().vertices.T
    radius = 0.25 + 0.06 * x
    ring = np.maximum(np.hypot(y, z), 1e-12)
    # Caps as on a capsule, a tube between them.
    profile = np.sqrt(np.clip(1 - np.abs(x) ** 6, 0, 1))
    along = 1.6 * np.sign(x) * np.abs(x) ** 1.2
    return np.stack(
        [along, radius * profile * y / ring, radius * profile * z / ring],
        axis=1,
    )


@cache
def unit_sphere():
    return trimesh.creation.icosphere(subdivisions=4)


def bent(vertices, angle=1.6):
    """Bent around an arc that keeps the lengths along the axis."""
    x, y, z = vertices.T
    radius = 2 * 1.6 / angle
    return np.stack(
        [(radius + y) * np.sin(x / radius), (radius + y) * np.cos(x / radius), z],
        1,
    )


def renumbered(vertices, faces):
    """The same surface: vertices, faces and the first corner of each face in another order."""
    generator = np.random.default_rng(0)
    order = generator.permutation(len(vertices))
    faces = generator.permutation(np.argsort(order)[faces])
    starts = generator.integers(3, size=(len(faces), 1))
    return vertices[order], np.take_along_axis(faces, (starts + np.arange(3)) % 3, axis=1)


def crooked():
    """Vertices of a body without any symmetry."""
    x, y, z = (unit_sphere().vertices * [0.5, 0.6, 1.6]).T
    return np.stack(
        [1.2 * x + 0.15 * y * z, y + 0.2 * x * x + 0.07 * z, 0.9 * z + 0.15 * np.sin(2 * x)],
        axis=1,
    )


BODIES = {"rod": rod, "crooked": crooked, "other": lambda: unit_sphere().vertices * [1, 0.8, 0.3]}


def surface(kind, change):
    """A body, or the same moved, scaled, bent, or given otherwise."""
    vertices = BODIES[kind]()
    faces = np.asarray(unit_sphere().faces)
    if change == "motion":  # `Mesh` turns what a reflection has turned inside out
        vertices = (vertices * [1, 1, -1]) @ ROTATION.T + [3.0, -2.0, 5.0]
    elif change == "quarter turns":  # the grid of samples stays
        vertices = vertices[:, [2, 0, 1]] * [-1, 1, -1]
    elif change == "scale":
        vertices = 7.3 * vertices
    elif change == "pose":
        vertices = bent(vertices)
    elif change == "numbers":
        vertices, faces = renumbered(vertices, faces)
    elif change == "finer":
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    return Mesh(vertices, faces, name=kind)


@cache
def body(kind, change=None):
    """With all that any descriptor needs."""
    mesh = surface(kind, change)
    everything = reduce(
        or_,
        (descriptor(name).requirements for name in NAMES),
        Requirements(),
    )
    config = SignatureConfig(
        n_eigenpairs=250, resolution=24, min_samples=400, n_surface_samples=600
    )
    return collate(
        [compute_signature(mesh, everything.apply_to(config))],
        [mesh],
    )


def signature(eigenvalues, interior, surface, of):
    config = SignatureConfig(n_eigenpairs=len(eigenvalues))
    sizes = (of.area, of.volume)
    return Signature(
        eigenvalues,
        interior,
        surface,
        *sizes,
        config,
        of.id,
        measures=of.measures,
    )


@cache
def description(name, kind, change=None):
    with torch.inference_mode():
        return descriptor(name)(body(kind, change))


def test_descriptors_are_named_and_say_where_they_are_from():
    for name in NAMES:
        found = igps.descriptor(name)
        assert found.name == name
        assert re.fullmatch("[a-z][a-z0-9_]*", name), "a name is typed in a shell, and names a file"
        assert re.search(r"(19|20)\d\d", found.source) or name == "pretrained"
        assert set(found.invariant_to) <= {"motion", "scale", "pose"}
        assert not found.training


@pytest.mark.parametrize("name", NAMES)
def test_descriptions_are_finite_numbers_of_one_shape_and_repeat(name):
    first = description(name, "rod")
    other = description(name, "other")
    assert first.dtype == other.dtype == torch.float32
    assert first.shape == other.shape
    assert first.ndim >= 2
    assert torch.isfinite(first).all()
    assert torch.isfinite(other).all()
    with torch.inference_mode():
        again = pickle.loads(pickle.dumps(descriptor(name)))(body("rod"))
    assert_close(again, first, rtol=0, atol=0)


@pytest.mark.parametrize("name", NAMES)
def test_padding_changes_no_description(name):
    signatures = []
    meshes = []
    for batch in (body("rod"), body("other")):
        (one,) = batch.bodies()
        signatures.append(
            signature(
                one.eigenvalues,
                one.interior,
                one.surface,
                one,
            )
        )
        meshes += batch.meshes or ()
    assert len(signatures[0].interior) != len(signatures[1].interior)
    with torch.inference_mode():
        together = descriptor(name)(collate(signatures, meshes))
    for row, kind in zip(together, ("rod", "other"), strict=True):
        scale = float(description(name, kind).abs().max())
        assert_close(row[None], description(name, kind), rtol=1e-4, atol=1e-5 * scale)


def with_individuals(name):
    """A descriptor that keeps size and side, too, where the name ends in "+"."""
    if name.endswith("+"):
        return descriptor(name.strip("+"), size="keep", mirror="distinct")
    return descriptor(name)


@pytest.mark.parametrize("name", ON_TENSORS)
def test_half_precision_describes_nearly_the_same(name):
    """Of the module, and of the samples; what is rounded to 3 or 2 digits falls into other cells now and then."""
    expected = description(name, "rod").flatten().float()
    with torch.inference_mode():
        halved = descriptor(name).to(torch.bfloat16)(body("rod"))
        of_half = descriptor(name)(body("rod").to(torch.bfloat16))
    for found in (halved, of_half):
        assert (
            float(
                torch.cosine_similarity(
                    found.flatten().float(),
                    expected,
                    dim=0,
                )
            )
            > 0.98
        )


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("name", [*NAMES, "rich+", "pretrained+"])
def test_tensors_are_made_on_the_device_of_the_bodies(name, compiled, request):
    """With the default device "meta", a tensor that is made without naming a device would have no values."""
    if not compiled:  # as on a GPU
        request.getfixturevalue("without_loops")
    found = with_individuals(name)
    with torch.inference_mode():
        expected = found(body("rod"))
        with torch.device("meta"):
            described = found(body("rod"))
            distances = found.distances(described, expected)
    assert_close(described, expected, rtol=0, atol=0)
    assert not distances.is_meta


def modules_of(name):
    return {type(one) for one in descriptor(name).modules()}


def assert_without_values(found, expected):
    shapes = {key: value.shape for key, value in expected.state_dict().items()}
    assert {key: value.shape for key, value in found.state_dict().items()} == shapes
    assert all(value.is_meta for value in [*found.parameters(), *found.buffers()])


@pytest.mark.parametrize(
    "name", [*NAMES, *FIELD_NAMES, "interior+size", "interior+side", "rich+ct+side+size"]
)
def test_a_descriptor_that_is_made_on_the_device_meta_has_no_values(name):
    with torch.device("meta"):
        found = igps.descriptor(name)
    assert_without_values(found, igps.descriptor(name))


@pytest.mark.parametrize("name", ["interior", "pretrained", "interior+side"])
def test_a_file_that_is_loaded_on_the_device_meta_has_no_values(name, tmp_path):
    path = tmp_path / "mine.safetensors"
    saved = igps.descriptor(name)
    saved.save(path)
    with torch.device("meta"):
        found = igps.load(path)
        by_name = igps.descriptor(path)
        both = igps.descriptor(saved, size="keep")
    assert_without_values(found, saved)
    assert_without_values(by_name, saved)
    assert not any(value.is_meta for value in both.buffers())


def fewer_samples(batch, n):
    return replace(
        batch, interior=batch.interior.subset(n, seed=0), surface=batch.surface.subset(n, seed=0)
    )


class Counting(TorchDispatchMode):
    """Counts the operations that reach a device, of which each that reads a number waits for it."""

    def __init__(self):
        super().__init__()
        self.found: Counter[str] = Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.found[str(func)] += 1
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("name", ON_TENSORS)
def test_a_batch_on_a_device_is_described_at_once(name, request, monkeypatch):
    """The number of operations does not depend on the number of bodies; descriptions equal those of single bodies."""
    found = descriptor(name)
    pair = SignatureBatch.concatenate(
        [fewer_samples(body("rod"), 200), fewer_samples(body("other"), 150)]
    )
    with torch.inference_mode():
        expected = torch.cat([found(pair[:1]), found(pair[1:])] * 3)
    request.getfixturevalue("without_loops")
    for block in ("batches.BLOCK", "pairs_by_torch._BLOCK"):  # all fit
        monkeypatch.setattr(f"igps.nn._kernels.{block}", 2**40)
    counts = []
    for n in (2, 3):
        several = SignatureBatch.concatenate([pair] * n)
        with torch.inference_mode(), Counting() as counting:
            together = found(several)
        counts.append(counting.found)
    assert counts[0] == counts[1]
    assert_close(
        together,
        expected,
        rtol=1e-4,
        atol=1e-5 * float(expected.abs().max()),
    )


def test_any_number_of_bodies_goes_through_an_exported_program():
    """Of the histograms of `pretrained` that the tests of pipelines do not export."""
    for other in ("interior", "gps", "multiscale", "rich"):
        assert modules_of(other) <= modules_of("pretrained") | {Attribute}
    known = (PairHistogram, PointHistogram)
    histograms = descriptor("pretrained").descriptor.histograms
    found = HistogramDescriptor([one for one in histograms if not isinstance(one, known)])
    rod, other = (body(kind) for kind in ("rod", "other"))
    several = SignatureBatch.concatenate([other, rod, other, body("rod", "pose")])
    with torch.no_grad():
        program = exported(found, SignatureBatch.concatenate([rod, other]))
        for batch in (several, other):
            assert_close(program(*tensors(batch)), found(batch), rtol=0, atol=1e-6)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("name", [*NAMES, "rich+", "pretrained+"])
def test_cuda_describes_as_the_cpu_does(name):
    found = with_individuals(name)
    with torch.inference_mode():
        expected = torch.cat([found(body(kind)) for kind in ("rod", "other")])
        distances = found.distances(expected, expected)
        found.cuda()
        described = torch.cat([found(body(kind).to("cuda")) for kind in ("rod", "other")])
        found_distances = found.distances(described, described)
    scale = float(expected.abs().max())
    assert_close(described.cpu(), expected, rtol=1e-4, atol=1e-5 * scale)
    assert_close(
        found_distances.cpu(),
        distances,
        rtol=1e-3,
        atol=1e-4 * float(distances.max()),
    )


def test_a_descriptor_is_traced_whole():
    """The one that has most kinds of histograms, with size, side and a head."""
    found = with_individuals("pretrained+")
    torch.compiler.reset()
    with torch.inference_mode():
        expected = found(body("rod"))
        traced = torch.compile(found, backend="eager", fullgraph=True)(body("rod"))
    assert_close(traced, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_distances_are_a_matrix_of_what_pairs_give(name):
    distance = descriptor(name).distances
    queries = torch.cat([description(name, kind) for kind in ("rod", "other")])
    gallery = torch.cat([description(name, *of) for of in (("other",), ("rod", "pose"), ("rod",))])
    matrix = distance(queries, gallery)
    assert matrix.shape == (2, 3)
    assert (matrix >= 0).all()
    scale = float(matrix.max())
    assert scale > 0
    assert abs(float(matrix[0, 2])) < 1e-3 * scale
    assert abs(float(matrix[1, 0])) < 1e-3 * scale
    for i in range(2):
        for j in range(3):
            pair = distance(
                queries[i : i + 1],
                gallery[j : j + 1],
            )
            expected = pytest.approx(
                matrix[i, j].item(),
                rel=1e-4,
                abs=1e-5 * scale,
            )
            assert pair.item() == expected


@pytest.mark.parametrize("name", NAMES)
def test_a_bent_body_is_closer_than_another(name):
    distance = descriptor(name).distances
    bent_rod, other = (
        float(distance(description(name, "rod"), description(name, *of)))
        for of in (("rod", "pose"), ("other",))
    )
    assert bent_rod < 0.75 * other


def movement(name, before, after):
    """Distance over the median of those between bodies; by cosines for a vector, whose head may not see it."""
    embedded = isinstance(descriptor(name), EmbeddedDescriptor)
    distance = cosine if embedded else descriptor(name).distances
    described = torch.cat([description(name, kind) for kind in BODIES])
    between = distance(described, described)[*torch.triu_indices(len(BODIES), len(BODIES), 1)]
    return float(distance(before, after) / between.median())


@pytest.mark.parametrize(("name", "change"), CHANGES)
def test_descriptions_are_invariant_as_claimed(name, change):
    distance = descriptor(name).distances
    changed = float(distance(description(name, "rod"), description(name, "rod", change)))
    other = float(distance(description(name, "rod"), description(name, "other")))
    # Rounding alone may let a descriptor simplify a mesh or choose its samples otherwise.
    assert changed < {"scale": 0.05, "motion": 0.2, "pose": 0.35}[change] * other
    if isinstance(descriptor(name), EmbeddedDescriptor) and change != "pose":
        moved = movement(name, description(name, "rod"), description(name, "rod", change))
        assert moved < {"scale": 0.05, "motion": 0.2}[change]


@pytest.mark.parametrize(
    ("change", "most"),
    [("quarter turns", 0.001), ("scale", 0.001), ("numbers", 0.001), ("finer", 0.1)],
)
@pytest.mark.parametrize("name", NAMES)
def test_a_surface_is_described_alike_however_it_is_given(name, change, most):
    """Nothing but rounding decides, unless it has four times the faces; of a body without symmetry."""
    if (name, change) == ("measures", "numbers"):
        most = 0.005  # of faces that are equally near, the first one tells where a ball grows
    before = description(name, "crooked")
    assert movement(name, before, description(name, "crooked", change)) < most


@pytest.mark.parametrize("name", NAMES)
def test_signs_and_bases_of_eigenfunctions_change_no_description(name):
    """Each two eigenvalues are made one, and its eigenfunctions turned: no descriptor takes one of them alone."""
    rod = body("crooked")
    values = rod.eigenvalues.reshape(1, -1, 2).mean(dim=2).repeat_interleave(2, dim=1)
    angles = torch.linspace(0, 6, values.shape[1] // 2)
    blocks = torch.stack([angles.cos(), angles.sin(), angles.sin(), -angles.cos()], dim=1)
    basis = torch.block_diag(*blocks.reshape(-1, 2, 2))

    def turned(samples):
        return replace(samples, eigenfunctions=samples.eigenfunctions @ basis)

    alike = replace(rod, eigenvalues=values)
    other = replace(alike, interior=turned(rod.interior), surface=turned(rod.surface))
    found = descriptor(name)
    with torch.inference_mode():
        assert movement(name, found(alike), found(other)) < 0.001


@pytest.mark.parametrize(
    "name", [name for name in NAMES if "pose" not in descriptor(name).invariant_to]
)
def test_descriptors_not_claimed_pose_invariant_change_with_pose(name):
    distance = descriptor(name).distances
    changed = float(distance(description(name, "rod"), description(name, "rod", "pose")))
    scaled = float(distance(description(name, "rod"), description(name, "rod", "scale")))
    assert changed > 0.02 * float(distance(description(name, "rod"), description(name, "other")))
    assert changed > 3 * scaled
