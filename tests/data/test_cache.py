import logging
import os
import stat
import time

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from igps.data.cache import Cache, decode, default_cache_dir, encode
from igps.signature.signature import Samples, Signature, SignatureConfig

KEY = "0123456789abcdef"


@pytest.fixture
def signature():
    generator = np.random.default_rng(0)

    def samples(n):
        values = generator.random((n, 3)).astype(np.float32)
        return Samples(
            generator.random((n, 3)),
            values,
            {"depth": values[:, 0].copy()},
        )

    return Signature(
        np.array([1.0, 2.0, 3.5]),
        samples(7),
        samples(4),
        3.25,
        0.1,
        SignatureConfig(n_eigenpairs=3),
        "a",
        ("turned",),
        2e-9,
    )


def test_round_trip_is_exact(tmp_path, signature):
    cache = Cache(tmp_path, "signature")
    assert KEY not in cache
    assert cache.get(KEY, decode) is None
    cache.put(KEY, encode(signature))
    assert KEY in cache
    restored = cache.get(KEY, decode)
    assert restored is not None
    assert restored.config == signature.config
    for name in ("area", "volume", "name", "notes", "residual"):
        assert getattr(restored, name) == getattr(signature, name)
    assert_array_equal(restored.eigenvalues, signature.eigenvalues)
    for room in ("interior", "surface"):
        before = getattr(signature, room)
        after = getattr(restored, room)
        assert_array_equal(after.points, before.points)
        assert_array_equal(after.eigenfunctions, before.eigenfunctions)
        assert_array_equal(after.attributes["depth"], before.attributes["depth"])


def truncate(path):
    path.write_bytes(path.read_bytes()[:-20])


def overwrite(path):
    path.write_bytes(b"not a tensor file at all")


def empty(path):
    path.write_bytes(b"")


def replace_by_foreign(path):
    save_file({"weights": np.zeros(3)}, path)


def belongs_to_another_key(path):
    path.write_bytes(
        path.read_bytes().replace(
            KEY.encode(),
            KEY[::-1].encode(),
        )
    )


@pytest.mark.parametrize(
    "damage", [truncate, overwrite, empty, replace_by_foreign, belongs_to_another_key]
)
def test_damaged_or_foreign_file_is_noticed(tmp_path, signature, damage, caplog):
    cache = Cache(tmp_path, "signature")
    cache.put(KEY, encode(signature))
    damage(cache.path(KEY))
    with caplog.at_level(logging.WARNING):
        assert KEY not in cache
        assert cache.get(KEY, decode) is None
    assert str(cache.path(KEY)) in caplog.text
    cache.put(KEY, encode(signature))
    assert cache.get(KEY, decode) is not None


@pytest.mark.parametrize("what", ["surface.eigenfunctions", "area"])
def test_damaged_payload_is_noticed(tmp_path, signature, what, caplog):
    """One bit or digit of what has no structure that could show it."""
    cache = Cache(tmp_path, "signature")
    cache.put(KEY, encode(signature))
    path = cache.path(KEY)
    content = bytearray(path.read_bytes())
    payload = b"3.25" if what == "area" else load_file(path)[what].tobytes()
    assert content.count(payload) == 1
    content[content.index(payload) + len(payload) - 1] ^= 1
    path.write_bytes(content)
    with caplog.at_level(logging.WARNING):
        assert cache.get(KEY, decode) is None
    assert f"{path}: cached signature is not usable (its content is damaged" in caplog.text
    cache.put(KEY, encode(signature))
    assert cache.get(KEY, decode) is not None


def test_file_without_a_checksum_is_not_trusted(tmp_path, signature):
    cache = Cache(tmp_path, "signature")
    cache.put(KEY, encode(signature))
    path = cache.path(KEY)
    with safe_open(path, framework="numpy") as file:
        metadata = file.metadata()
    del metadata["checksum"]
    save_file(load_file(path), path, metadata=metadata)
    assert cache.get(KEY, decode) is None


@pytest.mark.skipif(os.name != "posix", reason="permissions are those of POSIX")
def test_umask_says_who_may_read(tmp_path, signature):
    before = os.umask(0o027)
    try:
        Cache(tmp_path / "cache", "signature").put(KEY, encode(signature))
    finally:
        os.umask(before)
    path = Cache(tmp_path / "cache", "signature").path(KEY)
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o750


def test_what_a_killed_run_left_is_removed_later(tmp_path, signature):
    cache = Cache(tmp_path, "signature")
    folder = cache.path(KEY).parent
    folder.mkdir(parents=True)
    old = folder / "old.partial"
    fresh = folder / "fresh.partial"
    for path in (old, fresh):
        path.write_bytes(b"half of a file")
    os.utime(old, (time.time() - 2 * 24 * 3600,) * 2)
    cache.put(KEY, encode(signature))
    cache.remove_abandoned()
    # Another process may still write the fresh one
    assert set(folder.iterdir()) == {cache.path(KEY), fresh}


def test_failed_write_leaves_nothing(tmp_path, signature):
    cache = Cache(tmp_path, "signature")
    cache.path(KEY).mkdir(parents=True)
    with pytest.raises(OSError, match=KEY):
        cache.put(KEY, encode(signature))
    assert list(cache.path(KEY).parent.iterdir()) == [cache.path(KEY)]


def test_default_directory_follows_the_convention(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_dir() == tmp_path / "igps"


def test_a_user_without_a_home_is_told_what_to_give(monkeypatch):
    def no_home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr("igps.data.cache.Path.home", no_home)
    with pytest.raises(
        ValueError,
        match=r"cache_dir: expected a folder, because this user has no home .* --cache_dir",
    ):
        default_cache_dir()
