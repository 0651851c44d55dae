"""Descriptors written in YAML, and attributes that join one: the same numbers, quantiles kept, textures told."""

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from numpy.testing import assert_allclose
from trimesh.creation import icosphere

import igps
from igps.data.dataset import SignatureDataset
from igps.descriptors.pretrained.descriptor import pretrained_parts
from igps.descriptors.registry import descriptor
from igps.descriptors.with_attributes import WithAttributes
from igps.fields.volumes.image_attribute import ImageAttribute
from igps.nn import fit_centres
from igps.nn.description import describe
from igps.nn.specification import specification
from igps.retrieval import chi_square, retrieval_scores
from label_files import write_nifti

INTERIOR = """
class_path: igps.nn.descriptor.HistogramDescriptor
init_args:
  name: mine
  histograms:
    class_path: igps.nn.histograms.PairHistogram
    init_args:
      axes: [potential, {class_path: igps.nn.axes.InteriorDistance, init_args: {n_bins: 64}}]
      embedding: {class_path: igps.nn.embedding.SpectralEmbedding, init_args: {n_eigenpairs: 250}}
"""
# Lists of ten aliases of a list of ten aliases: 10⁹ values in a few lines
ALIASES = "a0: &a0 [1]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 10)
)
PRETRAINED = yaml.safe_dump(specification(pretrained_parts()))
HEIGHT = """
class_path: igps.nn.descriptor.HistogramDescriptor
init_args:
  name: mine
  histograms:
    class_path: igps.nn.histograms.PairHistogram
    init_args:
      axes:
        - {class_path: igps.nn.axes.Attribute, init_args: {name: height, quantiles: 4, soft: true}}
        - {class_path: igps.nn.axes.InteriorDistance, init_args: {n_bins: 8}}
      embedding: {class_path: igps.nn.embedding.SpectralEmbedding, init_args: {n_eigenpairs: 20}}
"""


def write(folder, text):
    (folder / "mine.yaml").write_text(text)
    return folder / "mine.yaml"


@pytest.fixture
def bodies(tmp_path):
    for i, stretch in enumerate(((1, 1, 1.7), (1, 1.3, 2.2), (1, 1, 1))):
        ball = icosphere(subdivisions=3)
        ball.vertices *= stretch
        ball.export(tmp_path / f"{i}.off")
    needs = igps.descriptor("interior").requirements | igps.descriptor("pretrained").requirements
    return SignatureDataset(tmp_path, cache_dir=tmp_path / "cache", descriptor=needs)


@pytest.mark.parametrize(
    ("text", "named"),
    [(INTERIOR, lambda: igps.descriptor("interior")), (PRETRAINED, pretrained_parts)],
)
def test_a_descriptor_of_the_library_written_down_gives_the_same_numbers(
    bodies, tmp_path, text, named
):

    own = igps.descriptor(write(tmp_path, text))
    theirs = named().eval()
    found = describe(bodies, own)
    expected = describe(bodies, theirs)
    assert torch.equal(found.flatten(1), expected.flatten(1))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "class_path: os.system\ninit_args: {command: touch hacked}",
            "'os.system' is no module of igps",
        ),
        ("class_path: igps.nn.axes.Colour", "igps.nn.axes.Colour is no module of igps"),
        ("class_path: igps.nn.colours.Colour", "No module named 'igps.nn.colours'"),
        (INTERIOR.replace("n_bins: 64", "bins: 64"), "unexpected keyword argument 'bins'"),
        (
            INTERIOR.replace("[potential,", "[colour,"),
            "axes: expected one of potential, .*'colour'",
        ),
        (INTERIOR.replace("n_bins: 64", "n_bins: 100000000"), "is too large"),
        (INTERIOR + "#" * 100_000, "at most 100000 bytes"),
        (ALIASES, "at most 10000 values"),
        (
            HEIGHT.replace("quantiles: 4", "quantiles: 1"),
            "expected centres, or at least 2 quantiles",
        ),
        ("parts: []", "a descriptor has the keys class_path and init_args"),
        ("5", "a descriptor has the keys class_path and init_args"),
        ("", "a descriptor has the keys class_path and init_args"),
        ("!!python/object/apply:os.system ['touch hacked']", "could not determine a constructor"),
        ("parts: [", "while parsing"),
    ],
)
def test_what_is_no_descriptor_is_told_with_what_there_is(tmp_path, text, sentence):
    with pytest.raises(ValueError, match=rf"mine\.yaml: expected a descriptor \(.*{sentence}.*"):
        igps.descriptor(str(write(tmp_path, text)))
    assert not Path("hacked").exists()
    with pytest.raises(FileNotFoundError, match=r"none\.yaml: no such file"):
        igps.descriptor("none.yaml")


def test_quantiles_are_those_of_the_collection_and_travel_with_the_descriptor(tmp_path):
    for i in range(2):
        icosphere(subdivisions=2, radius=1 + i).export(tmp_path / f"{i}.off")
    text = HEIGHT
    own = igps.descriptor(write(tmp_path, text))
    heights = {"height": lambda body, points: points[:, 2]}
    files = [tmp_path / f"{i}.off" for i in range(2)]
    dataset = SignatureDataset(
        files, cache_dir=tmp_path / "cache", descriptor=own, attributes=heights
    )
    with pytest.raises(
        ValueError, match="height: expected centres, got 4 quantiles that are not fitted"
    ):
        own(dataset.batch([0]))
    assert fit_centres(own, dataset)
    heights_of = [one.interior.attributes["height"][:500] for one in dataset.signatures()]
    expected = np.quantile(np.concatenate(heights_of), [0.125, 0.375, 0.625, 0.875])
    centres = own.histograms[0].axes[0].centres()
    assert_allclose(centres, expected, rtol=1e-5)
    described = describe(dataset, own)
    assert not fit_centres(own, dataset[[0]])
    own.save(tmp_path / "kept.safetensors")
    again = igps.descriptor(tmp_path / "kept.safetensors")
    assert torch.equal(describe(dataset[[0]], again), described[:1])
    bare = SignatureDataset(files, cache_dir=tmp_path / "cache", descriptor=own)
    with pytest.raises(
        ValueError,
        match=r"attributes: expected 'height' of each body, got \[\].*file: depth, .*, hydropathy, ",
    ):
        fit_centres(igps.descriptor(write(tmp_path, text)), bare)


def texture(kind, generator, points):
    """Graded, layered, mottled or with a core, in a direction and with a phase of its own."""
    direction = generator.normal(size=3)
    along = points @ (direction / np.linalg.norm(direction))
    if kind == "graded":
        return along
    if kind == "layered":
        return np.sin(9 * along + generator.uniform(0, 2 * np.pi))
    if kind == "mottled":
        waves = generator.normal(size=(20, 3)) * 9
        return np.cos(points @ waves.T + generator.uniform(0, 2 * np.pi, 20)).sum(axis=1) / 3
    return 2 * np.exp(-np.square(points).sum(axis=1) / 0.3) - 0.5


def test_attributes_tell_textures_of_one_shape_apart_and_form_alone_does_not(tmp_path):
    generator = np.random.default_rng(0)
    affine = np.diag([0.1, 0.1, 0.1, 1.0])
    affine[:3, 3] = -1.5
    voxels = np.stack(np.meshgrid(*[np.arange(31)] * 3, indexing="ij"), axis=-1) * 0.1 - 1.5
    files = []
    for kind in ("graded", "layered", "mottled", "core"):
        for i in range(4):
            files.append(tmp_path / "root" / kind / f"{i}.off")
            body = icosphere(subdivisions=3)
            body.vertices *= np.array([1, 0.8, 1.3]) * generator.uniform(0.98, 1.02, 3)
            (tmp_path / "root" / kind).mkdir(parents=True, exist_ok=True)
            body.export(files[-1])
            values = texture(kind, generator, voxels.reshape(-1, 3)).reshape(31, 31, 31)
            place = tmp_path / "root" / "ct" / kind / f"{i}.off.nii.gz"
            write_nifti(place, values.astype(np.float32), affine)
    images = {"ct": ImageAttribute("ct/{file}.nii.gz", tmp_path / "root")}
    found = {}
    labels = [path.parent.name for path in files]
    for name in ("shape_dna", "shape_dna+ct"):
        chosen = igps.descriptor(name)
        dataset = SignatureDataset(
            files, cache_dir=tmp_path / "cache", descriptor=chosen, attributes=images
        )
        fit_centres(chosen, dataset)
        described = describe(dataset, chosen)
        distances = chosen.distances(described, described)
        found[name] = retrieval_scores(distances, labels).mean()["nn"]
    assert found["shape_dna+ct"] >= 0.95
    assert found["shape_dna"] < 0.6


def test_an_attribute_adds_its_histograms_with_its_weight(bodies, tmp_path):
    files = [tmp_path / f"{i}.off" for i in range(3)]
    heights = {"height": lambda body, points: points[:, 2]}
    whole = igps.descriptor("pretrained+height=0.5")
    assert isinstance(whole, WithAttributes)
    dataset = SignatureDataset(
        files, cache_dir=tmp_path / "cache", descriptor=whole, attributes=heights
    )
    fit_centres(whole, dataset)
    described = describe(dataset, whole)
    form = describe(dataset, descriptor("pretrained"))
    inside = describe(dataset, whole.inside)
    assert_allclose(inside.sum(dim=1), 1, rtol=1e-5)
    by_bins = inside.reshape(3, 36, 32)  # pairs of eight classes
    levels = [by_bins, by_bins.reshape(3, 36, 8, 4).sum(dim=3), by_bins.sum(dim=2)]
    told = sum(chi_square(level.flatten(1), level.flatten(1)) for level in levels) / 3
    expected = descriptor("pretrained").distances(form, form) + 0.5 * 0.083 / 0.017 * told
    found = whole.distances(described, described)
    assert_allclose(found, expected, atol=1e-5)
    rows = whole.coordinates(described, within_class=True)
    kept = descriptor("pretrained").coordinates(form, within_class=True)
    assert_allclose(rows[:, : kept.shape[1]], kept, atol=1e-6)
    squares = rows[:, kept.shape[1] :].square()
    assert_allclose(squares, 0.5 * 0.083 / 0.017 * inside.flatten(1), atol=1e-5)
    assert igps.descriptor("pretrained+height=0.5+size").name == "pretrained+height=0.5+size"
    with pytest.raises(ValueError, match="with: expected positive weights"):
        igps.descriptor("interior+height=0")
