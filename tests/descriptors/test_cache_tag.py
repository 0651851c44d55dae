"""Under which words descriptions are kept: whatever changes them, changes the words."""

import shutil
from pathlib import Path

import pytest
import torch

import own_descriptors
from igps.descriptors import NAMES, descriptor, fingerprint
from igps.descriptors.fingerprint import cache_tag
from igps.nn.axes import Attribute, EuclideanDistance
from igps.nn.descriptor import EmbeddedDescriptor, HistogramDescriptor
from igps.nn.heads import WhitenedHead
from igps.nn.histograms.pairs import PairHistogram


@pytest.fixture(autouse=True)
def _forgotten():
    fingerprint._code_tag.cache_clear()
    yield
    fingerprint._code_tag.cache_clear()


def words():
    found = cache_tag(descriptor("d2"))
    assert found is not None
    return found


def test_every_descriptor_has_words_of_its_own():
    assert len({cache_tag(descriptor(name)) for name in NAMES} - {None}) == len(NAMES)
    assert words() == words()


def test_what_is_not_the_librarys_has_none():
    assert cache_tag(own_descriptors.Same()) is None
    assert cache_tag(EmbeddedDescriptor(own_descriptors.Same(), WhitenedHead())) is None


def test_a_hook_is_not_the_librarys():
    """It changes descriptions, which came from the cache without it."""
    for register in (
        torch.nn.Module.register_forward_hook,
        torch.nn.Module.register_forward_pre_hook,
    ):
        hooked = descriptor("interior")
        handle = register(next(hooked.children()), lambda *given: None)
        assert cache_tag(hooked) is None
        handle.remove()
        assert cache_tag(hooked) == cache_tag(descriptor("interior"))


def test_what_it_was_made_with_changes_the_words():
    one, other = (
        PairHistogram([EuclideanDistance(8), Attribute(name, [0.1, 0.2])])
        for name in ("depth", "twist")
    )
    assert cache_tag(HistogramDescriptor(one)) != cache_tag(HistogramDescriptor(other))
    small = cache_tag(own_descriptors.small_interior())
    assert small == cache_tag(own_descriptors.small_interior())
    assert small != cache_tag(descriptor("interior"))


def test_parameters_change_the_words():
    changed = descriptor("interior")
    with torch.no_grad():
        next(changed.buffers()).mul_(1.5)
    assert cache_tag(changed) != cache_tag(descriptor("interior"))


def test_the_code_changes_the_words(tmp_path, monkeypatch):
    before = words()
    copied = tmp_path / "igps"
    shutil.copytree(Path(fingerprint.__file__).parents[1], copied)
    monkeypatch.setattr(fingerprint, "__file__", str(copied / "descriptors" / "fingerprint.py"))
    fingerprint._code_tag.cache_clear()
    assert words() == before
    assert (copied / "nn" / "embedding.py").is_file()
    with (copied / "nn" / "embedding.py").open("a") as source:
        source.write("# one more line\n")
    fingerprint._code_tag.cache_clear()
    assert words() != before


def test_versions_change_the_words(monkeypatch):
    before = words()
    fingerprint._code_tag.cache_clear()
    version = fingerprint.importlib.metadata.version
    monkeypatch.setattr(
        fingerprint.importlib.metadata,
        "version",
        lambda name: version(name) + (name == "torch") * "+1",
    )
    assert words() != before
