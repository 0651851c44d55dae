"""An index of meshes against the comparison with each of them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

import igps
from igps.cli import main
from igps.data.dataset import SignatureDataset
from igps.data.sources import find_bodies
from igps.descriptors.fingerprint import fingerprint
from igps.gallery.gallery import Gallery
from igps.mesh.options import LoadOptions
from igps.nn.description import describe
from igps.nn.descriptor import EmbeddedDescriptor
from igps.nn.heads.two_level import TwoLevelHead
from igps.retrieval import chi_square
from igps.retrieval.index import VectorIndex
from igps.retrieval.ranking import SearchResult
from igps.signature.signature import SignatureConfig
from own_descriptors import SMALL, small_interior

pytest.importorskip("faiss")
pytest.importorskip("filelock")

INTERIOR = "own_descriptors:small_interior"
CONFIG = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=60)


def write_body(path: Path, width: float, height: float) -> None:
    """A stretched ball of 162 vertices."""
    body = trimesh.creation.icosphere(subdivisions=2)
    body.vertices *= [1.0, width, height]
    path.parent.mkdir(parents=True, exist_ok=True)
    body.export(path)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for label, ratio in (("ball", 1.0), ("egg", 2.2)):
        for i in range(3):
            write_body(tmp_path / "meshes" / label / f"{i}.off", 1.0 + 0.06 * i, ratio)
    return tmp_path / "meshes"


@pytest.fixture
def dataset(root: Path, tmp_path: Path) -> SignatureDataset:
    return SignatureDataset(root, CONFIG, tmp_path / "cache")


def command(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr(sys, "argv", ["igps", *map(str, arguments)])
    main()


def error_of(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    with pytest.raises(SystemExit, match="1"):
        command(monkeypatch, *arguments)
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("igps: ")]
    return line


def test_it_ranks_as_the_descriptor_does(dataset: SignatureDataset, root: Path, tmp_path: Path) -> None:
    gallery, failures = Gallery.build(tmp_path / "g.igps", dataset, small_interior(), n_workers=1)
    assert failures == []
    histograms = describe(dataset, small_interior())
    distances = chi_square(histograms[4:5], histograms)[0]
    found = gallery.query(root / "egg" / "1.off", top=4, cache_dir=tmp_path / "cache")
    nearest = torch.argsort(distances, stable=True)[:4].tolist()
    assert [match.name for match in found] == [dataset.bodies.names[i] for i in nearest]
    assert [match.label for match in found] == [(dataset.bodies.labels or ())[i] for i in nearest]
    assert [match.path for match in found] == [dataset.bodies.paths[i].resolve() for i in nearest]
    np.testing.assert_allclose([match.distance for match in found], distances[nearest], rtol=2e-3, atol=1e-6)


def test_more_are_ranked_under_a_head(
    dataset: SignatureDataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whose distance may be only near the cosine's, by which candidates are found."""
    asked = []
    search = VectorIndex.search

    def spied(index: VectorIndex, *arguments: object, **options: Any) -> SearchResult:
        asked.append(options["candidates"])
        return search(index, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(VectorIndex, "search", spied)
    histograms = describe(dataset, small_interior())
    embedded = EmbeddedDescriptor(small_interior(), TwoLevelHead().fit(histograms, dataset.labels))
    for descriptor, descriptions in ((small_interior(), histograms), (embedded, embedded.head(histograms))):
        gallery, _ = Gallery.build(tmp_path / f"{len(asked)}.igps", dataset, descriptor, n_workers=1)
        gallery.nearest(descriptions, top=3)
    assert asked[1] > asked[0] >= 512


def test_adding_and_merging_are_building(dataset: SignatureDataset, root: Path, tmp_path: Path) -> None:
    whole, _ = Gallery.build(tmp_path / "whole.igps", dataset, INTERIOR, n_workers=1)
    Gallery.build(tmp_path / "a.igps", dataset.subset([0, 1, 2]), INTERIOR, n_workers=1)
    added, _ = Gallery.add(tmp_path / "a.igps", dataset.subset([2, 3, 4]), INTERIOR, n_workers=1)
    assert len(added) == 5
    Gallery.build(tmp_path / "b.igps", dataset.subset([4, 5]), INTERIOR, n_workers=1)
    merged = Gallery.merge(tmp_path / "c.igps", [tmp_path / "a.igps", tmp_path / "b.igps"])
    described = describe(dataset, small_interior())
    assert merged.nearest(described) == whole.nearest(described)
    # A file of other content takes the place of what it was.
    write_body(root / "ball" / "1.off", 3.0, 0.3)
    changed, _ = Gallery.add(tmp_path / "c.igps", dataset, INTERIOR, n_workers=1)
    assert len(changed) == 6
    (first, *_) = changed.query(root / "ball" / "1.off", cache_dir=tmp_path / "cache")
    assert first.name == "ball/1.off"
    assert first.distance < 1e-6


def test_bodies_of_one_file_are_entries_of_their_own(tmp_path: Path) -> None:
    boxes = [trimesh.creation.box(extents=(1, 1, length)) for length in (1.0, 2.0, 4.0)]
    for i, one in enumerate(boxes):
        one.apply_translation((3 * i, 0, 0))
    trimesh.Scene({f"part {i}": one for i, one in enumerate(boxes)}).export(tmp_path / "plate.glb")
    bodies = find_bodies(tmp_path, LoadOptions(bodies="objects"))
    dataset = SignatureDataset(bodies, CONFIG, tmp_path / "cache", reading=LoadOptions(bodies="objects"))
    for make in (Gallery.build, Gallery.add):
        gallery, _ = make(tmp_path / "plate.igps", dataset, INTERIOR, n_workers=1)
        assert len(gallery) == 3
    found = gallery.nearest(describe(dataset, small_interior()), top=1)
    assert [one.name for (one,) in found] == list(bodies.names)
    assert {one.path for (one,) in found} == {(tmp_path / "plate.glb").resolve()}


def test_what_cannot_be_described_is_told(root: Path, tmp_path: Path) -> None:
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    gallery, failures = Gallery.build(tmp_path / "g.igps", dataset, "own_descriptors:picky", n_workers=1)
    assert [failure.id for failure in failures] == ["egg/1.off"]
    assert len(gallery) == 5
    added, failures = Gallery.add(tmp_path / "g.igps", dataset, "own_descriptors:picky", n_workers=1)
    assert [failure.id for failure in failures] == ["egg/1.off"]
    assert "too much" in failures[0].error
    assert len(added) == 5


def test_a_checksum_tells_descriptors_apart() -> None:
    assert fingerprint(small_interior()) == fingerprint(small_interior())
    torch.manual_seed(0)
    other = small_interior()
    buffer = next(other.buffers())
    buffer += 1e-3
    several = [small_interior(), other, igps.descriptor("rich"), igps.descriptor("pretrained"), igps.descriptor("d2")]
    assert len({fingerprint(one) for one in several}) == 5


def test_commands(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    index, cache = tmp_path / "gallery.igps", ["--cache_dir", tmp_path / "cache"]
    command(monkeypatch, "index", "build", root / "egg", "--out", index, "--descriptor", INTERIOR, *cache, *SMALL)
    assert capsys.readouterr().out.splitlines()[-1] == f"{index}: 3 meshes by {INTERIOR}"
    command(monkeypatch, "index", "add", root, "--index", index, *cache, "--n_workers", 1)
    # Those of the folder of one class have no class: they are known already.
    assert capsys.readouterr().out.splitlines()[-1] == f"{index}: 6 meshes by {INTERIOR}"
    command(monkeypatch, "index", "build", root, "--out", index, "--descriptor", INTERIOR, *cache, *SMALL)
    command(monkeypatch, "index", "merge", index, "--out", tmp_path / "copy.igps")
    assert capsys.readouterr().out.splitlines()[-1] == f"{tmp_path / 'copy.igps'}: 6 meshes by {INTERIOR}"

    wanted = root / "egg" / "1.off"
    command(monkeypatch, "query", wanted, "--gallery", root, "--descriptor", INTERIOR, "--top", 4, *cache, *SMALL)
    expected = capsys.readouterr().out
    for which in (index, tmp_path / "copy.igps"):
        command(monkeypatch, "query", wanted, "--index", which, "--top", 4, *cache)
        assert capsys.readouterr().out == expected
    command(monkeypatch, "query", wanted, "--gallery", root, "--descriptor", INTERIOR, "--rerank", *cache, *SMALL)
    reranked = capsys.readouterr().out
    assert len(reranked.splitlines()) == 7
    assert reranked.splitlines()[:5] != expected.splitlines()[:5]
    command(monkeypatch, "query", wanted, "--index", index, "--rerank", *cache)
    assert capsys.readouterr().out == reranked
    (root / "egg" / "0.off").unlink()
    command(monkeypatch, "query", wanted, "--index", index, "--top", 4, *cache)
    out = capsys.readouterr().out
    assert out.startswith(expected)
    assert out.splitlines()[-1] == "1 of these 4 files are no longer where they were when they were indexed."


def test_what_does_not_fit_is_refused_in_a_sentence(
    dataset: SignatureDataset, root: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    index, mesh = tmp_path / "g.igps", root / "egg" / "1.off"
    Gallery.build(index, dataset, INTERIOR, n_workers=1)
    query = ["query", mesh, "--index", index, "--cache_dir", tmp_path / "cache"]
    for options, words in (
        (["--descriptor", "rich"], f'another descriptor: it has "{INTERIOR}", not "rich"'),
        (["--signature.n_eigenpairs", 20, "--signature.resolution", 12], "another signature."),
        (["--mend", "never"], 'another reading.mend: it has "auto", not "never"'),
        (["--gallery", root], "gallery, index: expected one of them"),
    ):
        assert words in error_of(monkeypatch, capsys, *query, *options)
    assert "expected one of them" in error_of(monkeypatch, capsys, "query", mesh)
    assert "no index there" in error_of(monkeypatch, capsys, "query", mesh, "--index", tmp_path / "none.igps")
    monkeypatch.setattr(SignatureConfig, "ALGORITHM_VERSION", SignatureConfig.ALGORITHM_VERSION + 1)
    assert "version" in error_of(monkeypatch, capsys, *query)
    monkeypatch.undo()
    gone = error_of(monkeypatch, capsys, "index", "add", tmp_path / "gone", "--index", index)
    assert "gone: no such folder" in gone
    changed = small_interior()
    next(changed.buffers()).add_(1e-3)
    changed.name = INTERIOR
    with pytest.raises(ValueError, match="another model"):
        Gallery(index, changed)
    assert len(Gallery(index)) == 6
