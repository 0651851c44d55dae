"""A changed byte in a compressed stream: the body is as it was, or refused; never another one in silence."""

import gzip

import numpy as np
import pytest

from damaged_streams import WRITERS, changed, start_of_stream, stored, write_itk, write_nibabel
from igps.mesh.errors import MeshError
from igps.mesh.loading import load_mesh

N_CHANGES = 40


def volume_or_none(path):
    try:
        return load_mesh(path).volume
    except MeshError:
        return None


@pytest.mark.parametrize("name", WRITERS)
def test_changed_bytes_never_give_another_body(name, tmp_path):
    path = tmp_path / name
    WRITERS[name](path)
    expected = load_mesh(path).volume
    file = stored(path)
    content = file.read_bytes()
    start = start_of_stream(name, content)
    generator = np.random.default_rng(7)
    n_refused = 0
    for _ in range(N_CHANGES):
        damaged = changed(content, start, generator)
        file.write_bytes(damaged)
        volume = volume_or_none(path)
        n_refused += volume is None
        assert volume in (expected, None)
    assert n_refused > N_CHANGES // 2


def test_metaimage_without_the_size_of_its_data_is_read(tmp_path):
    write_itk(tmp_path / "mask.mha")
    content = (tmp_path / "mask.mha").read_bytes()
    head, mark, data = content.partition(b"ElementDataFile = LOCAL\n")
    lines = [line for line in head.splitlines() if not line.startswith(b"CompressedDataSize")]
    assert len(lines) < len(head.splitlines())
    (tmp_path / "other.mha").write_bytes(b"\n".join(lines) + b"\n" + mark + data)
    assert load_mesh(tmp_path / "other.mha").volume == load_mesh(tmp_path / "mask.mha").volume


def test_a_stream_that_unpacks_to_far_more_than_its_header_says_is_refused(tmp_path):
    write_nibabel(tmp_path / "mask.nii.gz")
    content = gzip.decompress((tmp_path / "mask.nii.gz").read_bytes())
    bomb = gzip.compress(content + bytes(1 << 27), compresslevel=1)
    (tmp_path / "mask.nii.gz").write_bytes(bomb)
    with pytest.raises(MeshError, match=r"mask\.nii\.gz: its compressed data unpacks to more"):
        load_mesh(tmp_path / "mask.nii.gz")
