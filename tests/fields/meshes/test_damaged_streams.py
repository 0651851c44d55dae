"""A changed byte in a compressed stream: the body is as it was, or refused; never another one in silence."""

from __future__ import annotations

import gzip
import io
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import meshio
import nibabel
import numpy as np
import pytest
import SimpleITK
import trimesh

from igps.mesh.errors import MeshError
from igps.mesh.loading import load_mesh

N_CHANGES = 60


def labels() -> np.ndarray:
    """A ball of label 1 beside a smaller one of label 1, in 24 x 20 x 16 voxels of 1 mm."""
    x, y, z = np.indices((24, 20, 16))
    large = (x - 9) ** 2 + (y - 9) ** 2 + (z - 8) ** 2 < 36
    small = (x - 16) ** 2 + (y - 9) ** 2 + (z - 8) ** 2 < 16
    return (large | small).astype(np.uint8)


def ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=2)


def write_nibabel(path: Path) -> None:
    kind = nibabel.MGHImage if path.suffix == ".mgz" else nibabel.Nifti1Image
    kind(labels(), np.eye(4)).to_filename(path)


def write_itk(path: Path) -> None:
    image = SimpleITK.GetImageFromArray(labels().T)
    SimpleITK.WriteImage(image, str(path), useCompression=True)


def write_vtu(path: Path) -> None:
    mesh = ball()
    cells = [("triangle", mesh.faces)]
    meshio.Mesh(mesh.vertices, cells).write(path, compression="zlib", header_type="UInt32")


def write_gifti(path: Path) -> None:
    mesh = ball()
    points = nibabel.gifti.GiftiDataArray(
        mesh.vertices.astype(np.float32), "NIFTI_INTENT_POINTSET", "NIFTI_TYPE_FLOAT32"
    )
    triangles = nibabel.gifti.GiftiDataArray(
        mesh.faces.astype(np.int32), "NIFTI_INTENT_TRIANGLE", "NIFTI_TYPE_INT32"
    )
    nibabel.GiftiImage(darrays=[points, triangles]).to_filename(path)


def write_zip(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("ball.off", ball().export(file_type="off"))


def write_tar(path: Path) -> None:
    content = ball().export(file_type="off").encode()
    with tarfile.open(path, "w:gz") as archive:
        info = tarfile.TarInfo("ball.off")
        info.size = len(content)
        archive.addfile(info, io.BytesIO(content))


def write_gzip(path: Path) -> None:
    path.write_bytes(gzip.compress(ball().export(file_type="off").encode()))


def write_3mf(path: Path) -> None:
    ball().export(path)


WRITERS: dict[str, Callable[[Path], None]] = {
    "mask.nii.gz": write_nibabel,
    "mask.mgz": write_nibabel,
    "mask.nrrd": write_itk,
    "mask.mha": write_itk,
    "mask.mhd": write_itk,
    "ball.vtu": write_vtu,
    "ball.gii": write_gifti,
    "ball.zip": write_zip,
    "ball.tar.gz": write_tar,
    "ball.off.gz": write_gzip,
    "ball.3mf": write_3mf,
}
# Where the compressed bytes begin, as a share of the file that holds them: behind headers, which have no checksum.
STARTS = {"ball.vtu": 0.3, "ball.gii": 0.4}


def changed(content: bytes, start: int, generator: np.random.Generator) -> bytes:
    """Change one to eight bytes behind `start`: other values, left out, or repeated."""
    at = int(generator.integers(start, len(content) - 8))
    n = int(generator.integers(1, 9))
    kind = generator.integers(3)
    if kind == 0:
        flips = generator.integers(1, 256, n).astype(np.uint8)
        old = np.frombuffer(content[at : at + n], np.uint8)
        return content[:at] + (old ^ flips).tobytes() + content[at + n :]
    if kind == 1:
        return content[:at] + content[at + n :]
    return content[: at + n] + content[at:]


def volume_or_none(path: Path) -> float | None:
    try:
        return load_mesh(path).volume
    except MeshError:
        return None


@pytest.mark.parametrize("name", WRITERS)
def test_changed_bytes_never_give_another_body(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    WRITERS[name](path)
    expected = load_mesh(path).volume
    stored = path.with_suffix(".zraw") if name.endswith(".mhd") else path
    content = stored.read_bytes()
    start = int(STARTS.get(name, 0.0) * len(content))
    for header_end in (b"ElementDataFile = LOCAL\n", b"\n\n"):
        if name.endswith((".mha", ".nrrd")) and header_end in content:
            start = content.index(header_end) + len(header_end)
            break
    generator = np.random.default_rng(7)
    n_refused = 0
    for _ in range(N_CHANGES):
        damaged = changed(content, start, generator)
        stored.write_bytes(damaged)
        volume = volume_or_none(path)
        n_refused += volume is None
        assert volume in (expected, None)
    assert n_refused > N_CHANGES // 2


def test_metaimage_without_the_size_of_its_data_is_read(tmp_path: Path) -> None:
    write_itk(tmp_path / "mask.mha")
    content = (tmp_path / "mask.mha").read_bytes()
    head, mark, data = content.partition(b"ElementDataFile = LOCAL\n")
    lines = [line for line in head.splitlines() if not line.startswith(b"CompressedDataSize")]
    assert len(lines) < len(head.splitlines())
    (tmp_path / "other.mha").write_bytes(b"\n".join(lines) + b"\n" + mark + data)
    assert load_mesh(tmp_path / "other.mha").volume == load_mesh(tmp_path / "mask.mha").volume


def test_a_stream_that_unpacks_to_far_more_than_its_header_says_is_refused(tmp_path: Path) -> None:
    write_nibabel(tmp_path / "mask.nii.gz")
    content = gzip.decompress((tmp_path / "mask.nii.gz").read_bytes())
    bomb = gzip.compress(content + bytes(1 << 27), compresslevel=1)
    (tmp_path / "mask.nii.gz").write_bytes(bomb)
    with pytest.raises(MeshError, match=r"mask\.nii\.gz: its compressed data unpacks to more"):
        load_mesh(tmp_path / "mask.nii.gz")
