"""Small bodies in every compressed format, and random changes of the compressed bytes."""

import base64
import gzip
import io
import tarfile
import zipfile
import zlib

import meshio
import nibabel
import numpy as np
import SimpleITK
import tifffile
import trimesh


def labels():
    """A ball of label 1 beside a smaller one of label 1, in 24 x 20 x 16 voxels of 1 mm."""
    x, y, z = np.indices((24, 20, 16))
    large = (x - 9) ** 2 + (y - 9) ** 2 + (z - 8) ** 2 < 36
    small = (x - 16) ** 2 + (y - 9) ** 2 + (z - 8) ** 2 < 16
    return (large | small).astype(np.uint8)


def ball():
    return trimesh.creation.icosphere(subdivisions=2)


def write_nibabel(path):
    kind = nibabel.MGHImage if path.suffix == ".mgz" else nibabel.Nifti1Image
    kind(labels(), np.eye(4)).to_filename(path)


def write_itk(path):
    image = SimpleITK.GetImageFromArray(labels().T)
    SimpleITK.WriteImage(image, str(path), useCompression=True)


def write_vtu(path):
    mesh = ball()
    cells = [("triangle", mesh.faces)]
    meshio.Mesh(mesh.vertices, cells).write(path, compression="zlib", header_type="UInt32")


def write_gifti(path):
    mesh = ball()
    array = nibabel.gifti.GiftiDataArray
    points = array(mesh.vertices.astype("f4"), "NIFTI_INTENT_POINTSET", "NIFTI_TYPE_FLOAT32")
    triangles = array(mesh.faces.astype("i4"), "NIFTI_INTENT_TRIANGLE", "NIFTI_TYPE_INT32")
    nibabel.GiftiImage(darrays=[points, triangles]).to_filename(path)


def write_zip(path):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("ball.off", ball().export(file_type="off"))


def write_tar(path):
    content = ball().export(file_type="off").encode()
    with tarfile.open(path, "w:gz") as archive:
        info = tarfile.TarInfo("ball.off")
        info.size = len(content)
        archive.addfile(info, io.BytesIO(content))


def write_gzip(path):
    path.write_bytes(gzip.compress(ball().export(file_type="off").encode()))


def write_3mf(path):
    ball().export(path)


def write_vtp(path):
    """Points and triangles as blocks of zlib, appended in base64, with headers of 64 bits."""
    mesh = ball()
    offsets = 3 * np.arange(1, len(mesh.faces) + 1)
    arrays = (mesh.vertices.astype("<f8"), mesh.faces.astype("<i8"), offsets.astype("<i8"))
    blocks = b""
    at = []
    for array in arrays:
        packed = zlib.compress(array.tobytes())
        header = np.array([1, array.nbytes, 0, len(packed)], "<u8").tobytes()
        at.append(len(blocks))
        blocks += base64.b64encode(header) + base64.b64encode(packed)
    counts = f'NumberOfPoints="{len(mesh.vertices)}" NumberOfPolys="{len(mesh.faces)}"'
    array = '<DataArray type="{}" Name="{}" format="appended" offset="{}"/>'.format
    points = array("Float64", "Points", at[0])
    cells = array("Int64", "connectivity", at[1]) + array("Int64", "offsets", at[2])
    head = '<VTKFile type="PolyData" byte_order="LittleEndian" header_type="UInt64" '
    head += (
        f'compressor="vtkZLibDataCompressor"><PolyData><Piece {counts}><Points>{points}</Points>'
    )
    head += f"<Polys>{cells}</Polys></Piece></PolyData>"
    appended = b'<AppendedData encoding="base64">_' + blocks + b"</AppendedData></VTKFile>"
    path.write_bytes(head.encode() + appended)


def write_tiff(path):
    tifffile.imwrite(path, labels().T, compression="zlib")


WRITERS = {
    "mask.nii.gz": write_nibabel,
    "mask.mgz": write_nibabel,
    "mask.nrrd": write_itk,
    "mask.mha": write_itk,
    "mask.mhd": write_itk,
    "mask.tif": write_tiff,
    "ball.vtu": write_vtu,
    "ball.vtp": write_vtp,
    "ball.gii": write_gifti,
    "ball.zip": write_zip,
    "ball.tar.gz": write_tar,
    "ball.off.gz": write_gzip,
    "ball.3mf": write_3mf,
}
# Where the compressed bytes begin, as a share of the file that holds them: behind headers, which have no checksum.
STARTS = {"ball.vtu": 0.3, "ball.vtp": 0.2, "ball.gii": 0.4, "mask.tif": 0.25}


def stored(path):
    """Return the file that holds the compressed bytes."""
    return path.with_suffix(".zraw") if path.suffix == ".mhd" else path


def start_of_stream(name, content):
    """Return the first place of a file, written as `name`, behind its header."""
    for header_end in (b"ElementDataFile = LOCAL\n", b"\n\n"):
        if name.endswith((".mha", ".nrrd")) and header_end in content:
            return content.index(header_end) + len(header_end)
    return int(STARTS.get(name, 0.0) * len(content))


def changed(content, start, generator):
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
