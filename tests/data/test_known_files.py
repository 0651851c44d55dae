import hashlib
import logging
import os
import sqlite3
import time
from pathlib import Path

import pytest

from bodies_on_disk import write_body
from igps.data.dataset import SignatureDataset
from igps.signature.signature import SignatureConfig

CONFIG = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=50)
LONG_AGO = time.time() - 1000


@pytest.fixture
def dataset(tmp_path):
    for i in range(3):
        write_body(tmp_path / "meshes" / f"{i}.off", 1.0 + 0.1 * i, 1.5)
        make_old(tmp_path / "meshes" / f"{i}.off")
    return SignatureDataset(tmp_path / "meshes", CONFIG, tmp_path / "cache")


pytestmark = pytest.mark.usefixtures("trust_recent_files")


@pytest.fixture
def read(monkeypatch):
    """Names of the mesh files that are read for their key."""
    names = []
    read_file = hashlib.file_digest

    def reading(file, algorithm):
        names.append(Path(file.name).name)
        return read_file(file, algorithm)

    monkeypatch.setattr("igps.data.keys.hashlib.file_digest", reading)
    return names


def make_old(path):
    os.utime(path, (LONG_AGO, LONG_AGO))


def test_files_that_did_not_change_are_not_read_again(dataset, read):
    dataset.precompute(n_workers=1, progress=False)
    assert set(read) == {"0.off", "1.off", "2.off"}
    read.clear()
    dataset.precompute(n_workers=1, progress=False)
    assert dataset.all_notes() == [()] * 3
    assert read == []


def test_a_changed_file_is_read_again(dataset, read, tmp_path):
    """Even to another of the same size, with the old time given back to it."""
    dataset.precompute(n_workers=1, progress=False)
    first, second = (tmp_path / "meshes" / f"{i}.off" for i in range(2))
    size = first.stat().st_size
    first.write_bytes(second.read_bytes()[:size].ljust(size, b"\n"))
    make_old(first)
    read.clear()
    dataset.precompute(n_workers=1, progress=False)
    assert set(read) == {"0.off"}
    n_stored = len(list((tmp_path / "cache").rglob("*.safetensors")))
    assert n_stored == 4 - (first.read_bytes() == second.read_bytes())


def test_a_file_that_changed_a_moment_ago_is_not_remembered(dataset, read, monkeypatch):
    monkeypatch.setattr("igps.data.known_files.MIN_AGE", 1000 * 10**9)
    dataset.precompute(n_workers=1, progress=False)
    read.clear()
    dataset.precompute(n_workers=1, progress=False)
    assert set(read) == {"0.off", "1.off", "2.off"}


@pytest.mark.parametrize("left", [None, 100])
def test_a_lost_signature_is_computed_again(dataset, tmp_path, left):
    dataset.precompute(n_workers=1, progress=False)
    before = {path: path.read_bytes() for path in (tmp_path / "cache").rglob("*.safetensors")}
    path = sorted(before)[0]
    path.unlink() if left is None else path.write_bytes(before[path][:left])
    dataset.precompute(n_workers=1, progress=False)
    after = {path: path.read_bytes() for path in (tmp_path / "cache").rglob("*.safetensors")}
    assert after == before


@pytest.mark.parametrize("fault", ["garbage", "another table", "a folder"])
def test_without_the_memory_all_goes_on(dataset, tmp_path, read, caplog, fault):
    dataset.precompute(n_workers=1, progress=False)
    memory = tmp_path / "cache" / "known_files.sqlite"
    memory.unlink()
    if fault == "garbage":
        memory.write_bytes(b"no database" * 1000)
    elif fault == "a folder":
        memory.mkdir()
    else:
        with sqlite3.connect(memory) as database:
            database.execute("CREATE TABLE file (x)")
        database.close()
    read.clear()
    with caplog.at_level(logging.WARNING):
        assert dataset.precompute(n_workers=1, progress=False) == []
    assert "known_files.sqlite: not usable" in caplog.text
    assert set(read) == {"0.off", "1.off", "2.off"}
    dataset.precompute(n_workers=1, progress=False)
