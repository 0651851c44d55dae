"""Descriptors in files: what was saved comes back to the bit; what is hostile is refused in a sentence."""

import json
import os
import pickle
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

import igps
import own_descriptors
from batches import two_bodies
from igps.descriptors.fingerprint import fingerprint
from igps.descriptors.registry import NAMES
from igps.nn.axes import EuclideanDistance, InteriorDistance, Potential
from igps.nn.descriptor import EmbeddedDescriptor, HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.heads import ClassifierHead, WhitenedHead
from igps.nn.histograms.pairs import PairHistogram
from igps.nn.specification import specification


def learnable():
    """Two histograms that share one embedding with parameters."""
    embedding = SpectralEmbedding(n_eigenpairs=6, n_knots=5)
    one = PairHistogram(
        [Potential(2, learnable=True), InteriorDistance(n_bins=5)], embedding, n_samples=40
    )
    return HistogramDescriptor([one, PairHistogram(["interior_distance"], embedding)], name="mine")


def test_a_folder_to_share_has_the_model_and_its_card(tmp_path, here):
    """By the names that hubs of models expect; a folder that is called as a descriptor of the library hides none."""
    descriptor = learnable()
    batch = two_bodies()
    for folder in ("shared", "rich"):
        descriptor.save(folder, {"author": "me", "classes": ["cat", "dog"]})
        assert sorted(path.name for path in Path(folder).iterdir()) == [
            "README.md",
            "model.safetensors",
        ]
    card = Path("shared/README.md").read_text()
    assert card.startswith("---\nlibrary_name: igps\n")
    assert '| classes | `["cat", "dog"]` |' in card
    for found in (
        igps.load("shared"),
        igps.descriptor("shared"),
        igps.descriptor(tmp_path / "shared"),
    ):
        assert torch.equal(found(batch), descriptor(batch))
        assert found.card["author"] == "me"
    assert igps.descriptor("rich").name == "rich"
    with pytest.raises(ValueError, match="got ''"):
        igps.descriptor("")
    Path("empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"empty/model\.safetensors: no such file"):
        igps.load("empty")


def test_the_umask_says_who_may_read_a_model_and_the_system_why_none_is_written(tmp_path):
    before = os.umask(0o027)
    try:
        igps.descriptor("interior").save(tmp_path / "mine.safetensors")
    finally:
        os.umask(before)
    assert (tmp_path / "mine.safetensors").stat().st_mode & 0o777 == 0o640
    (tmp_path / "folder.safetensors").mkdir()
    with pytest.raises(OSError, match=r"folder\.safetensors"):
        igps.descriptor("interior").save(tmp_path / "folder.safetensors")
    assert sorted(os.listdir(tmp_path)) == ["folder.safetensors", "mine.safetensors"]


@pytest.mark.parametrize("name", [*NAMES, "fold", "molecular"])
def test_every_descriptor_of_the_library_comes_back(name, tmp_path):
    descriptor = igps.descriptor(name)
    descriptor.save(tmp_path / "mine.safetensors")
    found = igps.load(tmp_path / "mine.safetensors")
    assert type(found) is type(descriptor)
    assert found.name == name
    assert found.requirements == descriptor.requirements
    assert not found.training
    assert fingerprint(found) == fingerprint(descriptor)


def test_trained_parameters_and_what_is_shared_come_back(tmp_path):
    descriptor = learnable()
    batch = two_bodies()
    with torch.no_grad():
        for parameter in descriptor.parameters():
            parameter += 0.1 * torch.randn(
                parameter.shape, generator=torch.Generator().manual_seed(0)
            )
    descriptor.save(tmp_path / "mine.safetensors", {"fitted to": "nothing"})
    found = igps.descriptor(tmp_path / "mine.safetensors")
    assert found.card == {"fitted to": "nothing"}
    assert isinstance(found, HistogramDescriptor)
    assert found.histograms[0].embedding is found.histograms[1].embedding
    assert torch.equal(found(batch), descriptor.eval()(batch))
    found.save(tmp_path / "again.safetensors")
    assert igps.load(tmp_path / "again.safetensors").card == found.card


def test_a_fitted_head_comes_back_with_its_sizes(tmp_path):
    histograms = torch.rand(6, 4, generator=torch.Generator().manual_seed(1))
    histograms /= histograms.sum(dim=1, keepdim=True)
    head = WhitenedHead(2).fit(
        histograms,
        torch.tensor([0, 0, 1, 1, 2, 2]),
        (1, 3),
    )
    base = HistogramDescriptor(PairHistogram([EuclideanDistance(4)]))
    EmbeddedDescriptor(base, head, name="mine").save(tmp_path / "mine.safetensors")
    found = igps.load(tmp_path / "mine.safetensors")
    assert isinstance(found, EmbeddedDescriptor)
    assert torch.equal(found.head(histograms), head(histograms))
    assert found.n_features == 4


def test_a_model_saved_twice_is_the_same_file(tmp_path):
    for i in range(8):
        learnable().save(tmp_path / f"{i}.safetensors", {"author": "me"})
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1


def test_what_was_changed_since_it_was_made_is_not_saved_as_it_was(tmp_path):
    """It came back as another descriptor, under another name, or not at all."""

    def named(one):
        one.name = "other"

    def fewer(one):
        one.histograms[0].n_samples = 30

    def replaced(one):
        one.histograms[1].axes[0] = EuclideanDistance(64)

    for change, said in (
        (named, "name"),
        (fewer, r"histograms\.0\.n_samples"),
        (replaced, r"histograms\.1\.axes\.0"),
    ):
        descriptor = learnable()
        change(descriptor)
        with pytest.raises(ValueError, match=f"^{said}: expected its initial value, got another"):
            descriptor.save(tmp_path / "mine.safetensors")
        assert not (tmp_path / "mine.safetensors").exists()


def test_what_is_of_others_is_not_saved(tmp_path):
    with pytest.raises(
        ValueError, match=r"made of modules of igps and numbers, got own_descriptors\.Height"
    ):
        own_descriptors.Height().save(tmp_path / "mine.safetensors")
    assert not (tmp_path / "mine.safetensors").exists()


def histogram(**arguments):
    return {"class_path": "igps.nn.histograms.pairs.PairHistogram", "init_args": arguments}


HOSTILE = {
    "another package": lambda: {"class_path": "subprocess.Popen", "init_args": {"args": "true"}},
    "a function": lambda: {
        "class_path": "igps.nn.specification.load_module",
        "init_args": {"path": "x"},
    },
    "an imported class": lambda: {"class_path": "igps.nn.specification.Path", "init_args": {}},
    "another room": lambda: {
        "class_path": "igps.data.dataset.SignatureDataset",
        "init_args": {"root_or_paths": "/"},
    },
    "no class": lambda: {"class_path": "igps.nn.histograms.pairs.Nothing"},
    "no descriptor": lambda: histogram(),
    "wrong words": lambda: {**specification(learnable()), "init_args": {"nothing": 1}},
    "more keys": lambda: {**specification(learnable()), "run": "rm"},
    "too large": lambda: {
        "class_path": "igps.nn.heads.learned.ProjectionHead",
        "init_args": {"width": 90_000, "n_hidden": 90_000},
    },
    "too many": lambda: {
        "class_path": "igps.nn.descriptor.HistogramDescriptor",
        "init_args": {"histograms": [histogram()] * 300},
    },
    "a long number": lambda: histogram(n_samples=10**9),
    "itself": lambda: {"same_as": 0},
    "other sizes": lambda: specification(
        HistogramDescriptor(PairHistogram([Potential(3), InteriorDistance(5)]))
    ),
    "a list": lambda: [1],
    "deep": lambda: json.loads("[" * 900 + "]" * 900),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_a_hostile_file_is_refused_in_a_sentence(what, tmp_path):
    path = tmp_path / "mine.safetensors"
    learnable().save(path)
    words = {
        "format": "igps-descriptor-1",
        "specification": json.dumps(HOSTILE[what]()),
        "card": "{}",
    }
    save_file(load_file(path), path, metadata=words)
    with pytest.raises(ValueError, match=r"mine\.safetensors: expected a descriptor") as caught:
        igps.load(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("parameter", "shape"),
    [
        ("temperature", (2,)),
        ("members", (2,)),
        ("coefficients", (3, 7)),
        ("whitened.mean", (3,)),
    ],
)
def test_a_head_whose_sizes_do_not_fit_is_refused(parameter, shape, tmp_path):
    """Else it shows when all bodies are described, and not which file is at fault."""
    path = tmp_path / "mine.safetensors"
    histograms = torch.rand(6, 4, generator=torch.Generator().manual_seed(1))
    base = HistogramDescriptor(PairHistogram([EuclideanDistance(4)]))
    model = EmbeddedDescriptor(
        base,
        ClassifierHead().fit(
            histograms,
            torch.tensor([0, 0, 1, 1, 2, 2]),
        ),
        name="mine",
    )
    model.save(path)
    assert torch.equal(
        igps.load(path).head.state_dict()["coefficients"], model.head.state_dict()["coefficients"]
    )
    words = {
        "format": "igps-descriptor-1",
        "specification": json.dumps(specification(model)),
        "card": "{}",
    }
    state = load_file(path)
    state[f"head.{parameter}"] = torch.zeros(shape, dtype=state[f"head.{parameter}"].dtype)
    save_file(state, path, metadata=words)
    with pytest.raises(
        ValueError, match=r"mine\.safetensors: expected a (descriptor|head for 4 cells)"
    ):
        igps.load(path)


def test_what_is_no_such_file_is_refused(tmp_path):
    path = tmp_path / "mine.safetensors"
    learnable().save(path)
    content = path.read_bytes()
    state = load_file(path)
    for wrong in (
        b"",
        b"nothing",
        content[:-9],
        pickle.dumps([1]),
        (2**40).to_bytes(8, "little") + content[8:],
    ):
        path.write_bytes(wrong)
        with pytest.raises(ValueError, match="expected a descriptor in the format"):
            igps.load(path)
    save_file(state, path)
    with pytest.raises(ValueError, match="its format is None"):
        igps.load(path)
    path.write_bytes(content)
    state = {name: torch.full_like(value, torch.nan) for name, value in state.items()}
    words = {
        "format": "igps-descriptor-1",
        "specification": json.dumps(specification(learnable())),
        "card": "{}",
    }
    save_file(state, path, metadata=words)
    with pytest.raises(ValueError, match="a parameter is not finite"):
        igps.load(path)
    with pytest.raises(FileNotFoundError, match="gone"):
        igps.descriptor(tmp_path / "gone.safetensors")


def test_a_name_that_no_file_may_have_is_not_saved(tmp_path):
    spaced = HistogramDescriptor(PairHistogram(["interior_distance"]), name="two words")
    with pytest.raises(ValueError, match="name: expected letters, digits and _, got 'two words'"):
        spaced.save(tmp_path / "mine.safetensors")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("card", ["5", "null", "[1]", '"scale"', "[" * 9000 + "]" * 9000])
def test_a_card_that_is_no_table_is_refused(card, tmp_path):
    path = tmp_path / "mine.safetensors"
    learnable().save(path, {"scale": "1:100"})
    assert igps.load(path).scale is None  # a word of one's own, and no distance
    words = {
        "format": "igps-descriptor-1",
        "specification": json.dumps(specification(learnable())),
        "card": card,
    }
    save_file(load_file(path), path, metadata=words)
    with pytest.raises(ValueError, match=r"mine\.safetensors: expected a descriptor"):
        igps.load(path)


def test_numbers_of_a_description_are_known():
    batch = two_bodies()
    assert learnable().n_features == learnable()(batch).shape[1]
    assert igps.descriptor("interior").n_features == 640
    pretrained = igps.descriptor("pretrained")
    assert isinstance(pretrained, EmbeddedDescriptor)
    assert pretrained.n_features == 1068
    assert pretrained.descriptor.n_features == sum(pretrained.descriptor.part_cells)
    assert own_descriptors.Same().n_features == 1
    assert igps.descriptor("d2").n_features == 64
