"""A collection in one file, without its meshes: what was written comes back; what is damaged or foreign does not."""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from bodies_on_disk import write_body
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from igps.data.cache import Record, checksum
from igps.data.collation import collate
from igps.data.dataset import SignatureDataset
from igps.data.requirements import Requirements
from igps.mesh.errors import MeshError
from igps.mesh.options import LoadOptions
from igps.signature.signature import SignatureConfig

# An odd number of eigenpairs and samples: arrays of doubles must not begin amid a word.
CONFIG = SignatureConfig(
    n_eigenpairs=13, resolution=9, min_samples=0, n_surface_samples=21, attributes=("depth",)
)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[SignatureDataset, Path]:
    """A dataset of two classes in memory, and its file; the meshes and the cache are gone."""
    folder = tmp_path_factory.mktemp("collection")
    for label, ratio in (("ball", 1.0), ("egg", 1.7)):
        for i in (1, 2):
            write_body(folder / "meshes" / label / f"{i}.off", 1.0 + 0.05 * i, ratio)
    dataset = SignatureDataset(
        folder / "meshes", CONFIG, folder / "cache", reading=LoadOptions("never")
    )
    dataset.precompute(n_workers=1, progress=False)
    dataset.to_file(folder / "signatures.igps")
    kept = dataset.to_memory()
    shutil.rmtree(folder / "meshes")
    shutil.rmtree(folder / "cache")
    return kept, folder / "signatures.igps"


def test_it_comes_back_to_the_bit_without_meshes(written):
    before, path = written
    after = SignatureDataset.from_file(path)
    assert after.bodies.names == before.bodies.names
    assert (after.classes, after.labels.tolist()) == (("ball", "egg"), [0, 0, 1, 1])
    assert (after.config, after.reading) == (before.config, before.reading)
    assert after.cached_keys() == before.cached_keys() != [None] * 4
    assert [after.key(i) for i in range(4)] == after.cached_keys()
    assert after.precompute() == []
    for one, other in zip(after, before, strict=True):
        assert (one.id, one.label) == (other.id, other.label)
        assert (one.signature.config, one.signature.notes) == (
            other.signature.config,
            other.signature.notes,
        )
        assert (one.signature.area, one.signature.volume) == (
            other.signature.area,
            other.signature.volume,
        )
        assert one.signature.name == one.id
        np.testing.assert_array_equal(one.signature.eigenvalues, other.signature.eigenvalues)
        for a, b in (
            (one.signature.interior, other.signature.interior),
            (one.signature.surface, other.signature.surface),
        ):
            np.testing.assert_array_equal(a.points, b.points)
            np.testing.assert_array_equal(a.eigenfunctions, b.eigenfunctions)
            assert a.attributes.keys() == b.attributes.keys()
            for name, values in b.attributes.items():
                np.testing.assert_array_equal(a.attributes[name], values)
    with pytest.raises(
        MeshError, match=r"ball/1\.off: .*signatures\.igps holds signatures and no meshes"
    ):
        after.mesh(0)


def test_it_is_read_by_any_reader_of_tensors(written):
    before, path = written
    found = load_file(path)
    np.testing.assert_array_equal(
        found["2.interior.eigenfunctions"], before[2].signature.interior.eigenfunctions
    )
    assert str(path.parent).encode() not in path.read_bytes()[:100_000]  # no path of the machine


def test_parts_of_it_are_written_again_and_go_to_other_processes(written, tmp_path):
    before, path = written
    part = SignatureDataset.from_file(path)[["egg/2.off", "ball/1.off"]]
    sent = pickle.dumps(part)
    assert len(sent) < 10_000
    part.to_file(tmp_path / "part.igps")
    for one in (pickle.loads(sent), SignatureDataset.from_file(tmp_path / "part.igps")):
        assert one.bodies.names == ("egg/2.off", "ball/1.off")
        assert one.labels.tolist() == [1, 0]
        expected = collate([before[3], before[0]])
        assert torch.equal(
            one.batch([0, 1]).interior.eigenfunctions, expected.interior.eigenfunctions
        )


def test_what_a_descriptor_requires_is_asked_of_it(written):
    SignatureDataset.from_file(written[1], descriptor=Requirements(13, ("depth",)))
    with pytest.raises(
        ValueError,
        match=r"\.igps: n_eigenpairs: .* at least 14, got 13\. .*export the collection again",
    ):
        SignatureDataset.from_file(written[1], descriptor=Requirements(14))


@pytest.mark.parametrize(
    "where",
    ["0.interior.points", "3.surface.eigenfunctions", "2.interior.attributes.depth", "area"],
)
def test_a_damaged_signature_is_named_and_costs_no_other(written, tmp_path, where):
    before, path = written
    content = bytearray(path.read_bytes())
    if where == "area":
        payload = json.dumps(before[1].signature.area)[-5:].encode()
        at = content.index(payload)
        number = 1
    else:
        payload = load_file(path)[where].tobytes()
        at = content.index(payload)
        number = int(where[0])
    content[at] ^= 1
    (tmp_path / "damaged.igps").write_bytes(content)
    damaged = SignatureDataset.from_file(tmp_path / "damaged.igps")
    for i, name in enumerate(before.bodies.names):
        if i == number:
            with pytest.raises(
                ValueError, match=rf"damaged\.igps: {name} is not usable \(its content is damaged"
            ):
                damaged[i]
        else:
            assert damaged[i].id == name


@pytest.mark.parametrize("word", [b"egg/2.off", b"ball"])
def test_a_damaged_name_is_noticed(written, tmp_path, word):
    content = bytearray(written[1].read_bytes())
    content[content.index(word) + 1] ^= 1
    (tmp_path / "damaged.igps").write_bytes(content)
    with pytest.raises(ValueError, match=r"damaged\.igps: expected a collection .*Export it again"):
        SignatureDataset.from_file(tmp_path / "damaged.igps")


def told(path: Path, target: Path, **changes: object) -> Path:
    """The same file that tells something else of itself."""
    with safe_open(path, framework="np") as file:
        metadata = file.metadata()
    about = json.loads(metadata["about"])
    about.update({name: value for name, value in changes.items() if name != "format"})
    metadata["about"] = json.dumps(about)
    metadata["format"] = str(changes.get("format", metadata["format"]))
    metadata["checksum"] = checksum(Record({}, {"about": metadata["about"]}))
    save_file(load_file(path), target, metadata=metadata)
    return target


@pytest.mark.parametrize(
    "changes",
    [
        {"format": "igps-collection-0"},
        {"names": ["a", "b", "c"]},
        {"names": ["a", "a", "b", "c"]},
        {"names": ["a", "b", "c", 4]},
        {"labels": ["ball", "egg", "egg", "fish"]},
        {"parts": [None, None, None, 1]},
        {"keys": "four"},
        {"columns": {"age": ["1", "2", "3"]}},
        {"columns": {"age": ["1", "2", "3", 4]}},
        {"config": {"n_eigenpairs": -1}},
        {"config": {"unknown": 3, "attributes": []}},
        {"reading": {"mend": "perhaps"}},
        {"reading": [1]},
    ],
)
def test_a_file_that_tells_nonsense_is_refused(written, tmp_path, changes):
    path = told(written[1], tmp_path / "told.igps", **changes)
    with pytest.raises(ValueError, match=r"told\.igps.*Export it again"):
        SignatureDataset.from_file(path)


def test_what_is_no_collection_is_refused(written, tmp_path):
    content = written[1].read_bytes()
    huge = (2**40).to_bytes(8, "little") + content[8:]
    for i, wrong in enumerate(
        (b"", b"no tensors at all", content[:-20], content[:100], huge, pickle.dumps([1]))
    ):
        path = tmp_path / f"{i}.igps"
        path.write_bytes(wrong)
        with pytest.raises(ValueError, match=rf"{i}\.igps: expected a collection"):
            SignatureDataset.from_file(path)
    with pytest.raises(FileNotFoundError, match="gone"):
        SignatureDataset.from_file(tmp_path / "gone.igps")


def test_labels_may_be_numbers_and_each_body_is_there_once(tmp_path):
    """What is written can be read: it was not, where labels were numbers, or a file was given twice."""
    paths = [tmp_path / f"{i}.off" for i in range(3)]
    for i, path in enumerate(paths):
        write_body(path, 1.0, 1.5 + 0.1 * i)
    dataset = SignatureDataset(paths, CONFIG, tmp_path / "cache", labels=np.array([10, 2, 10]))
    assert dataset.labels.tolist() == [1, 0, 1]
    dataset.to_file(tmp_path / "signatures.igps")
    found = SignatureDataset.from_file(tmp_path / "signatures.igps")
    assert found.classes == ("2", "10")
    assert found.labels.tolist() == [1, 0, 1]
    twice = SignatureDataset([*paths, paths[0]], CONFIG, tmp_path / "cache")
    with pytest.raises(ValueError, match=r"twice\.igps: expected unique names, got .*0\.off twice"):
        twice.to_file(tmp_path / "twice.igps")
    assert not (tmp_path / "twice.igps").exists()


def test_a_failed_export_leaves_what_was_there(tmp_path):
    write_body(tmp_path / "meshes" / "1.off", 1.1, 1.5)
    (tmp_path / "meshes" / "2.off").write_text("nothing")
    (tmp_path / "signatures.igps").write_bytes(b"before")
    dataset = SignatureDataset(tmp_path / "meshes", CONFIG, tmp_path / "cache")
    with pytest.raises(MeshError, match=r"2\.off"):
        dataset.to_file(tmp_path / "signatures.igps")
    assert (tmp_path / "signatures.igps").read_bytes() == b"before"
    assert not list(tmp_path.glob("*.partial"))
