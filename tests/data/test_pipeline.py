import gzip
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from bodies_on_disk import write_body
from igps.data import keys
from igps.data.cache_hit import CacheHit
from igps.data.pipeline import SignaturePipeline
from igps.failures import Failed
from igps.mesh.errors import MeshError
from igps.mesh.loading import BodyRef, load_mesh
from igps.mesh.mending import MENDING_VERSION
from igps.mesh.options import LoadOptions
from igps.signature.measures import MEASURES_VERSION, measures
from igps.signature.signature import SignatureConfig, compute_signature

CONFIG = SignatureConfig(n_eigenpairs=12, resolution=8, min_samples=0, n_surface_samples=20)


@pytest.fixture
def path(tmp_path):
    write_body(tmp_path / "egg.off", 1.1, 1.5)
    return tmp_path / "egg.off"


@pytest.fixture
def pipeline(tmp_path):
    return SignaturePipeline(CONFIG, LoadOptions(), tmp_path / "cache")


def found(pipeline, body):
    return pipeline.find(body, pipeline.content(body))


def is_cached(pipeline, body):
    try:
        return isinstance(found(pipeline, body), CacheHit)
    except MeshError:
        return False


def test_a_signature_is_computed_once_and_is_that_of_the_mesh(pipeline, path):
    assert not is_cached(pipeline, BodyRef(path))
    first = pipeline.signature(BodyRef(path))
    assert is_cached(pipeline, BodyRef(path))
    stored = pipeline.cache("signature").path(pipeline.key(BodyRef(path)))
    written = stored.stat().st_mtime_ns
    expected = compute_signature(pipeline.mesh(BodyRef(path)), CONFIG)
    for one in (first, pipeline.signature(BodyRef(path))):
        np.testing.assert_array_equal(one.interior.eigenfunctions, expected.interior.eigenfunctions)
        np.testing.assert_array_equal(one.eigenvalues, expected.eigenvalues)
    assert stored.stat().st_mtime_ns == written


def test_fill_caches_and_returns_only_what_serves(pipeline, path):
    filled = pipeline.fill([BodyRef(path)])
    assert len(pickle.dumps(filled)) < 1000
    assert is_cached(pipeline, BodyRef(path))
    assert [found(pipeline, BodyRef(path))] == filled == pipeline.fill([BodyRef(path)])


def test_a_worker_gets_a_small_copy(pipeline, path):
    sent = pickle.dumps(pipeline)
    assert len(sent) < 2000
    assert pickle.loads(sent) == pipeline
    assert pickle.loads(sent).key(BodyRef(path)) == pipeline.key(BodyRef(path))


def test_keys_are_told_apart_by_content_reading_parameters_and_suffix_alone(
    pipeline, path, tmp_path
):
    copy = tmp_path / "copy.off"
    renamed = tmp_path / "egg.obj"
    other = tmp_path / "other.off"
    shutil.copy(path, copy)
    shutil.copy(path, renamed)
    write_body(other, 1.1, 1.6)
    assert pipeline.key(BodyRef(copy)) == pipeline.key(BodyRef(path))
    assert replace(pipeline, cache_dir=tmp_path).key(BodyRef(path)) == pipeline.key(BodyRef(path))
    pipelines = [pipeline, replace(pipeline, config=replace(CONFIG, seed=1))]
    for given in ({"mend": "never"}, {"mend": "always"}, {"allow_open": True}):
        pipelines.append(replace(pipeline, reading=LoadOptions(**given)))
    keys = [one.key(BodyRef(path)) for one in pipelines]
    keys += [pipeline.key(BodyRef(renamed)), pipeline.key(BodyRef(other))]
    assert len(set(keys)) == len(keys)


def test_the_key_tells_pdb_from_pqr_also_when_compressed(pipeline, tmp_path):
    """A PDB line without an element is valid PQR, with its occupancy as charge and its B-factor as radius."""
    line = b"ATOM      1  CA  ALA A   1      11.104   6.134  -6.504  1.00  4.00\n"
    names = [f"a.{kind}{packed}" for kind in ("pqr", "pdb", "PQR") for packed in (".gz", "")]
    for name in names:
        packed = gzip.compress(line, mtime=0)
        (tmp_path / name).write_bytes(packed if name.endswith(".gz") else line)
    keys = [pipeline.key(BodyRef(tmp_path / name)) for name in names]
    assert keys[4:] == keys[:2]
    assert len(set(keys)) == 4


def test_keys_are_those_of_the_caches_that_exist(pipeline, tmp_path):
    """Frozen: another key leaves all caches useless. It changes with the versions alone."""
    (tmp_path / "frozen.off").write_bytes(b"OFF\n")
    assert SignatureConfig.ALGORITHM_VERSION == 5
    assert MENDING_VERSION == 12
    assert MEASURES_VERSION == 8
    key = pipeline.key(BodyRef(tmp_path / "frozen.off"))
    assert key == "773e4ce7a00388cd0f47d6b700c1aa2e1f4dc95b25b2497aa672453f23ae9923"


def test_plain_numbers_are_computed_where_they_are_asked_for_and_once(pipeline, path):
    without = pipeline.fill([BodyRef(path)])[0]
    assert without.measures == {}
    assert pipeline.signature(BodyRef(path)).measures == {}
    asking = replace(pipeline, config=replace(CONFIG, measures=True))
    assert not is_cached(asking, BodyRef(path))
    numbers = measures(pipeline.mesh(BodyRef(path)))
    expected = pytest.approx(numbers, rel=1e-9, abs=1e-9)
    stored = pipeline.cache("signature").path(without.key)
    written = stored.stat().st_mtime_ns
    [found_now] = asking.fill([BodyRef(path)])
    assert found_now.key == without.key
    assert found_now.measures == expected
    assert asking.signature(BodyRef(path)).measures == expected
    [file] = asking.cache("measure").directory.rglob("*.safetensors")
    first = file.stat().st_mtime_ns
    asking.fill([BodyRef(path)])
    assert file.stat().st_mtime_ns == first
    assert stored.stat().st_mtime_ns == written
    file.write_bytes(file.read_bytes()[:-1])
    assert not is_cached(asking, BodyRef(path))
    assert asking.signature(BodyRef(path)).measures == expected


@pytest.mark.parametrize("shape", ["egg", "box"])
def test_a_body_has_one_record_of_plain_numbers_whatever_the_configuration(
    pipeline, path, monkeypatch, shape
):
    if shape == "box":  # which is subdivided for eigenpairs
        trimesh.creation.box((1, 2, 3)).export(path)
    body = BodyRef(path)
    expected = measures(load_mesh(path))
    configs = [
        SignatureConfig(n_eigenpairs=0, n_surface_samples=20),
        SignatureConfig(n_eigenpairs=20, n_surface_samples=30, seed=1),
        replace(CONFIG, max_vertices=30),
    ]
    for n, config in enumerate(configs):
        cache_dir = pipeline.cache_dir.with_name(f"cache {n}")
        alone = replace(pipeline, config=replace(config, measures=True), cache_dir=cache_dir)
        assert alone.signature(body).measures == expected
        in_memory = replace(alone, meshes={body: load_mesh(path)})
        assert in_memory.signature(body).measures == expected
    monkeypatch.delattr("igps.data.pipeline.measures")
    for config in configs:
        reader = replace(alone, config=replace(config, measures=True))
        assert reader.signature(body).measures == expected


def test_another_version_makes_other_keys(pipeline, path, monkeypatch):
    pipeline.fill([BodyRef(path)])
    before = pipeline.key(BodyRef(path))
    monkeypatch.setattr("igps.data.keys.MENDING_VERSION", MENDING_VERSION + 1)
    keys._parameters.cache_clear()
    assert pipeline.key(BodyRef(path)) != before
    assert not is_cached(pipeline, BodyRef(path))
    monkeypatch.undo()
    keys._parameters.cache_clear()
    assert is_cached(pipeline, BodyRef(path))


def test_a_body_that_cannot_be_used_is_not_read_again_until_it_changes(pipeline, tmp_path):
    path = tmp_path / "thin.off"
    copy = tmp_path / "copy.off"
    path.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    shutil.copy(path, copy)
    with pytest.raises(MeshError) as first:
        pipeline.fill([BodyRef(path)])
    assert found(pipeline, BodyRef(path)) == Failed(str(first.value))
    assert found(pipeline, BodyRef(copy)) is None  # its message would name the other file
    with pytest.raises(MeshError) as second:
        pipeline.fill([BodyRef(path)])
    assert str(second.value) == str(first.value)
    write_body(path, 1.1, 1.5)
    assert isinstance(pipeline.fill([BodyRef(path)])[0], CacheHit)


def test_a_missing_file_is_named(pipeline, tmp_path):
    gone = BodyRef(tmp_path / "gone.off")
    assert not is_cached(pipeline, gone)
    for function in (pipeline.key, pipeline.signature, pipeline.mesh):
        with pytest.raises(MeshError, match=r"gone\.off"):
            function(gone)
