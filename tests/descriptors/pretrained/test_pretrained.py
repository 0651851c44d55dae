"""`rich` is its parts side by side; `pretrained` is the shipped head on top of its own parts."""

from dataclasses import replace

import pytest
import torch
import trimesh
from safetensors.torch import load_file, save_file
from torch.nn.functional import normalize
from torch.testing import assert_close
from training.pretrain import save_pretrained
from training.shapes import GradedShapes
from training.shapes.templates import TEMPLATES

import igps
from igps import Mesh, collate
from igps.data.dataset import SignatureDataset
from igps.descriptors.pretrained.descriptor import (
    BODY_PARTS,
    CLASS_PARTS,
    PRETRAINED,
    pretrained,
    pretrained_head,
    pretrained_parts,
)
from igps.descriptors.rich import rich
from igps.nn.description import describe
from igps.nn.descriptor import EmbeddedDescriptor, HistogramDescriptor
from igps.nn.heads.two_level import TwoLevelHead
from igps.retrieval import chi_square, cosine, retrieval_scores
from igps.shapes import ArticulatedShapes
from igps.signature.signature import SignatureConfig, compute_signature

# Of `rich`: six histograms in its first part, two oriented ones.
CELLS = (25920, 750, 750)
# Of `pretrained_parts`
PART_CELLS = (640, 750, 750, 1000, 1920, 576, 16, 180, 91)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Shapes of a seed that the shipped head was not fitted to."""
    root = tmp_path_factory.mktemp("shapes")
    shapes = ArticulatedShapes(8, n_per_class=3, seed=7, n_vertices=800, templates=TEMPLATES)
    shapes.write(root)
    needs = rich().requirements | pretrained_parts().requirements
    config = needs.apply_to(SignatureConfig(n_eigenpairs=90, n_surface_samples=1000))
    return SignatureDataset(root, config, root / "cache")


@pytest.fixture(scope="module")
def histograms(dataset):
    return describe(dataset, igps.descriptor("rich"))


def test_rich_is_its_histograms_side_by_side_with_equal_shares(dataset, histograms):
    """Each computed alone, without what they share."""
    found = igps.descriptor("rich")
    assert isinstance(found, HistogramDescriptor)
    assert found.part_cells == CELLS
    batch = dataset.batch([0, 7])
    expected = []
    with torch.inference_mode():
        for part in found.parts:
            expected += [histogram(batch).flatten(1) / (3 * len(part)) for histogram in part]
    assert_close(
        histograms[[0, 7]],
        torch.cat(expected, dim=1),
        rtol=1e-4,
        atol=1e-7,
    )
    for part in histograms.split(CELLS, dim=1):
        assert_close(
            part.sum(dim=1),
            torch.full((len(part),), 1 / 3),
            rtol=1e-4,
            atol=0,
        )
    # The distance of the whole is then the mean of those of the parts, each a histogram of sum 1.
    of_parts = [chi_square(3 * part, 3 * part) for part in histograms.split(CELLS, dim=1)]
    whole = found.distances(histograms, histograms)
    assert_close(
        whole,
        torch.stack(of_parts).mean(dim=0),
        rtol=1e-4,
        atol=1e-6,
    )


def test_a_class_is_closer_to_itself(dataset, histograms):
    """NN and FT of `rich`; as a control, FT of shuffled labels, where 2 of 23 other shapes (9 %) match."""
    distances = igps.descriptor("rich").distances(histograms, histograms)
    scores = retrieval_scores(distances, dataset.labels).mean()
    order = torch.randperm(
        len(dataset),
        generator=torch.Generator().manual_seed(0),
    )
    shuffled = dataset.labels[order]
    by_chance = retrieval_scores(chi_square(histograms, histograms), shuffled).mean()
    assert scores["nn"] > 0.9
    assert scores["ft"] > 0.7
    assert by_chance["ft"] < 0.3


def test_pretrained_is_what_its_parameters_say(dataset):
    """Written down from the stored numbers: roots, directions and lengths part by part."""
    part = dataset.subset(range(4))
    module = pretrained()
    roots = describe(part, module.descriptor).double().sqrt()
    stored = {name: tensor.double() for name, tensor in load_file(PRETRAINED).items()}

    def level(name, parts):
        keys = [key for key in stored if f".{name}." in key]
        of_level = {key.rsplit(".", 1)[1]: stored[key] for key in keys}
        assert of_level["part_cells"].long().tolist() == list(PART_CELLS)
        sizes = [PART_CELLS[i] for i in parts]
        seen = torch.cat(
            [roots.split(PART_CELLS, dim=1)[i] for i in parts],
            dim=1,
        )
        centred = (seen - of_level["mean"]).split(sizes, dim=1)
        directions = of_level["directions"].split(sizes, dim=1)
        projected = [a @ b[: a.shape[1]].T for a, b in zip(centred, directions, strict=True)]
        if of_level["lengths"]:
            vectors = torch.cat(projected, dim=1)
            last = (1 - vectors.square().sum(dim=1, keepdim=True)).sqrt()
            return torch.cat([vectors, last], dim=1)
        return normalize(
            torch.cat(
                [normalize(one) for one in projected],
                dim=1,
            )
        )

    classes = level("class_head", CLASS_PARTS)
    bodies = [level(f"body_heads.{k}", (part,)) for k, part in enumerate(BODY_PARTS)]
    share, scales, exponents = (stored[f"head.{name}"] for name in ("share", "scales", "exponents"))
    found = describe(part, module)
    of_bodies = [(share / 2).sqrt() * one for one in bodies]
    expected = torch.cat(
        [(1 - share).sqrt() * classes, *of_bodies],
        dim=1,
    )
    assert_close(found.double(), expected, atol=1e-4, rtol=0)
    from_mean = torch.stack([one[:, :-1].square().sum(dim=1) for one in bodies]).mean(dim=0).sqrt()
    shorter = (torch.outer(from_mean, from_mean).sqrt() / (0.5 / 2**0.5)).sqrt()
    exponent = torch.zeros(4, 4, dtype=torch.float64)
    between = torch.ones(4, 4, dtype=torch.float64)
    for one, scale, power in zip(bodies, scales, exponents, strict=True):
        apart = torch.cdist(
            one[:, :-1],
            one[:, :-1],
            compute_mode="donot_use_mm_for_euclid_dist",
        )
        exponent += (apart * shorter / scale) ** 20
        between *= apart**power
    differ = (1 - torch.exp(-exponent)) * (1 - torch.exp(-((between / 0.1) ** 20)))
    distances = 0.95 * (1 - classes @ classes.T) * differ
    distances += 0.05 * (1 - torch.exp(-((between / 0.1) ** 2)))
    assert_close(
        module.distances(found, found).double(),
        distances,
        atol=2e-3,
        rtol=0,
    )


def test_pretrained_gives_unit_vectors_and_short_ones(dataset):
    """By cosines, short vectors lose less than 0.02 of FT."""
    module = pretrained()
    found = describe(dataset, module)
    assert isinstance(module.head, TwoLevelHead)
    short = module.head.shorten(found)
    assert short.shape == (len(dataset), 256)
    for vectors in (found, short):
        expected = torch.ones(len(dataset))
        assert_close(
            vectors.norm(dim=1),
            expected,
            atol=1e-5,
            rtol=0,
        )
    whole, of_short = (
        retrieval_scores(cosine(one, one), dataset.labels).mean()["ft"] for one in (found, short)
    )
    assert of_short > whole - 0.02


def test_pretrained_gains_on_shapes_it_has_not_seen(tmp_path):
    """Over the plain distance of `rich`, and over that of its own histograms: on classes that are hard to tell apart.

    Of another seed than those that it was fitted to, and without the twelve templates, which all descriptors tell.
    """
    GradedShapes(6, 3, 1, seed=3, n_vertices=(1500, 2000), look_alikes=False).write(tmp_path)
    module = pretrained()
    plain = rich()
    config = (module.requirements | plain.requirements).apply_to(SignatureConfig(n_eigenpairs=90))
    dataset = SignatureDataset(tmp_path, config, tmp_path / "cache")
    assert not dataset.precompute(n_workers=1)

    def first_tier(distances):
        return retrieval_scores(distances, dataset.labels).mean()["ft"]

    own = describe(dataset, module.descriptor)
    others = describe(dataset, plain)
    embedded = module.head(own)
    learned = first_tier(module.distances(embedded, embedded))
    assert learned > first_tier(chi_square(others, others)) + 0.1
    assert learned > first_tier(chi_square(own, own)) + 0.1


def test_a_head_of_ones_own_is_stored_and_loaded(dataset, tmp_path):
    dataset = dataset.subset(range(20))
    descriptor = pretrained_parts().eval()
    described = describe(dataset, descriptor)
    head = pretrained_head().fit(described, dataset.labels, descriptor.part_cells)
    save_pretrained(EmbeddedDescriptor(descriptor, head), tmp_path / "head.safetensors")
    loaded = pretrained(tmp_path / "head.safetensors")
    assert not loaded.training
    assert_close(describe(dataset, loaded), head(described), atol=5e-3, rtol=0)
    shipped = pretrained().head(described)
    assert shipped.shape[1] != head(described).shape[1] or not torch.allclose(
        shipped, head(described), atol=0.1
    )


def test_a_file_of_another_head_is_named(tmp_path):
    path = tmp_path / "other.safetensors"
    save_file({"head.mean": torch.zeros(3)}, path)
    with pytest.raises(
        ValueError, match=r"other\.safetensors: expected the parameters of `pretrained`"
    ):
        pretrained(path)
    with pytest.raises(FileNotFoundError):
        pretrained(tmp_path / "missing.safetensors")


def test_coordinates_within_a_class_separate_a_small_difference_from_sampling():
    """A width that differs by 3 % changes them more than other samples do; for whole vectors it does not."""
    descriptor = igps.descriptor("pretrained")
    config = descriptor.requirements.apply_to(SignatureConfig())
    ball = trimesh.creation.icosphere(subdivisions=3)

    def described(width, seed):
        bend = [0.3, 0, 0] * ball.vertices[:, 2:] ** 2
        body = Mesh(
            ball.vertices * [0.8 * width, 0.6, 1.6] + bend,
            ball.faces,
        )
        return descriptor(
            collate(
                [
                    compute_signature(
                        body,
                        replace(config, seed=seed),
                    )
                ]
            )
        )

    descriptions = torch.cat([described(width, seed) for width in (1.0, 1.03) for seed in range(3)])
    coordinates = descriptor.coordinates(descriptions, within_class=True)
    within = torch.cdist(coordinates, coordinates)
    whole = torch.cdist(descriptions, descriptions)
    same = torch.block_diag(*2 * [torch.ones(3, 3)]).bool()
    assert within[same].max() < within[~same].min()
    assert descriptor.coordinates(descriptions).equal(descriptions)
    assert whole[same].max() > whole[~same].min()
