"""Readers of volume files by nibabel, SimpleITK, highdicom and tifffile; sizes are checked before voxels are read."""

import gzip
import math
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats
from igps.fields.volumes._streams import check_gzip, check_rest, check_zlib
from igps.fields.volumes.label_names import names_in_extensions
from igps.mesh.errors import MeshError
from igps.mesh.limits import check_fits
from igps.mesh.mesh import Frame, unit_of_length
from igps.mesh.raw_body import UnitSource

_WORK_BYTES = 4  # bytes a voxel to hold and count labels, beyond those of the file
_LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])  # DICOM and ITK use LPS
_EXPORT = "Export the labels."
_NRRD = (".nrrd", ".nhdr")
_META = (".mha", ".mhd")
_NIFTI_UNITS = {1: 1e3, 2: 1.0, 3: 1e-3}  # metres, millimetres, micrometres, in millimetres
_MAX_HEADER = 1 << 24  # bytes
_MAX_TAGS = 1 << 26  # bytes around the voxels of a compressed NIfTI or MGH file
# Spacings closer than this, as a share, differ by the rounding of a header.
_SPACING_TOLERANCE = 0.01
_META_COMPRESSED = re.compile(
    rb"^\s*CompressedData\s*[=:]\s*(true|1|yes)", re.MULTILINE | re.IGNORECASE
)
_META_SIZE = re.compile(rb"^\s*CompressedDataSize\s*[=:]\s*(\d+)", re.MULTILINE | re.IGNORECASE)
# The line of a NRRD or MetaImage header that says where the patient's sides are.
_HAS_ORIENTATION = re.compile(
    rb"^space:\s*(left|right|[lr][ap]s)|^\s*(TransformMatrix|AnatomicalOrientation)\s*[=:]",
    re.MULTILINE | re.IGNORECASE,
)
_META_SPACING = re.compile(rb"^\s*Element(Spacing|Size)\s*[=:]", re.MULTILINE | re.IGNORECASE)
_NRRD_SPACING = re.compile(rb"^(spacings|space directions):.*$", re.MULTILINE | re.IGNORECASE)
# The line of a NRRD or MetaImage header that names the file of the voxels; ":" may stand for "=" in MetaImage.
_DATA_FILE = re.compile(
    rb"(?:ElementDataFile[ \t]*[=:]|^data ?file:)[ \t]*(?:\./)?(.*?)[ \t]*\r?$",
    re.MULTILINE | re.IGNORECASE,
)


@dataclass
class RawVolume:
    """A volume as it was read, before its values are taken for labels."""

    layers: list[NDArray[Any]]  # (X, Y, Z) of any type
    affine: Floats  # (4, 4) from voxel indices to the world
    names: dict[int, str] = field(default_factory=dict)  # of the values of a single layer
    # (name, layer, value), if the file lists them
    segments: list[tuple[str, int, int]] = field(default_factory=list)
    unit: str | None = "mm"  # of length; None if the file states no lengths
    frame: Frame = "RAS"  # None if the file does not say how the patient lies
    unit_from: UnitSource = "default"  # what states the unit
    notes: list[str] = field(default_factory=list)  # remarks on its geometry, for the user


def read_raw(path: Path) -> RawVolume:
    """Read a volume with the reader for its suffix."""
    reader = READERS.get(suffix_of(path))
    if reader is None:
        raise MeshError(
            f"{path}: not a format of volumes. Convert it to one of {', '.join(READERS)}."
        )
    return reader(path)


def suffix_of(path: Path) -> str:
    """Return the suffix in lower case; ".nii.gz" counts as one."""
    name = path.name.lower()
    return ".nii.gz" if name.endswith(".nii.gz") else path.suffix.lower()


def check_voxels(
    path: str | Path, shape: Sequence[int], n_bytes: int, n_components: int = 1
) -> None:
    """Raise a MeshError unless a volume has three axes, several slices, one value a voxel, and fits into memory."""
    if n_components != 1:
        raise MeshError(
            f"{path}: {n_components} values in each voxel, as in colours; expected one label. {_EXPORT}"
        )
    size = [int(n) for n in shape]
    while len(size) > 3 and size[-1] == 1:
        size.pop()
    shown = " × ".join(map(str, size))
    if len(size) != 3:
        raise MeshError(
            f"{path}: expected three axes, got {len(size)} axes, {shown}. Export each volume to a file."
        )
    if min(size) < 2:
        raise MeshError(
            f"{path}: {shown} voxels are a single slice, which has no volume. Export the whole stack."
        )
    remedy = "Crop or resample the volume; if it is smaller, its header is damaged."
    check_fits(
        math.prod(size) * (n_bytes + _WORK_BYTES),
        f"{path}: {math.prod(size):,} voxels need",
        remedy,
    )


def _not_integers(path: str | Path, kind: str) -> MeshError:
    return MeshError(f"{path}: expected voxels of whole numbers, got {kind}. {_EXPORT}")


def _nibabel(path: Path) -> RawVolume:
    import nibabel

    image: Any = nibabel.load(path)
    # Of compressed files, nibabel stops behind the last voxel
    if isinstance(image, nibabel.Nifti1Image) and path.suffix.lower() == ".gz":
        n_bytes = _checked_bytes(image, path, n_copies=2)
        proxy: Any = image.dataobj
        with gzip.open(path) as stream:
            # At once: nibabel's own reading takes three times as long
            content = stream.read(proxy.offset + n_bytes)
            check_rest(stream, path, n_more=_MAX_TAGS)
        return _volume_of(type(image).from_bytes(content))
    volume = of_nibabel(image, path)
    if path.suffix.lower() == ".mgz":
        (values,) = volume.layers
        n_bytes = values.size * np.dtype(image.get_data_dtype()).itemsize
        check_gzip(path, n_bytes, n_more=_MAX_TAGS)
    return volume


def of_nibabel(image: Any, path: str | Path) -> RawVolume:
    """Read an image of nibabel; `path` names it in messages."""
    _checked_bytes(image, path)
    return _volume_of(image)


def _checked_bytes(image: Any, path: str | Path, n_copies: int = 1) -> int:
    """Return the bytes of all voxels; a MeshError if they are no numbers, or so many copies do not fit into memory."""
    dtype = np.dtype(image.get_data_dtype())
    if dtype.fields or dtype.kind not in "biuf":
        raise _not_integers(path, f"{'colours' if dtype.fields else 'complex numbers'} ({dtype})")
    check_voxels(path, image.shape, n_copies * max(dtype.itemsize, 1))
    return math.prod(image.shape) * dtype.itemsize


def _volume_of(image: Any) -> RawVolume:
    """Read a checked image of nibabel."""
    import nibabel

    values = np.asanyarray(image.dataobj).reshape(image.shape[:3])
    affine = np.array(image.affine, dtype=np.float64)
    names: dict[int, str] = {}
    notes: list[str] = []
    frame: Frame = "RAS"
    source: UnitSource = "format"
    if isinstance(image, nibabel.Nifti1Pair):  # the base class of all NIfTI images
        notes = _spacing_notes(image)
        has_orientation = image.header["sform_code"] or image.header["qform_code"]
        frame = "RAS" if has_orientation else None
        unit_code = int(image.header["xyzt_units"]) % 8
        affine[:3] *= _NIFTI_UNITS.get(unit_code, 1.0)
        source = "header" if unit_code in _NIFTI_UNITS else "default"
        names = names_in_extensions(
            bytes(x.get_content_bytes())
            if hasattr(x, "get_content_bytes")
            else str(x.get_content()).encode()
            for x in image.header.extensions
        )
    return RawVolume([values], affine, names, notes=notes, frame=frame, unit_from=source)


def _spacing_notes(image: Any) -> list[str]:
    """Return a note if the two geometries of a NIfTI header, sform and qform, differ in the size of a voxel."""
    if not image.header["sform_code"]:
        return []
    sides = {
        "sform": np.linalg.norm(image.affine[:3, :3], axis=0),
        "qform": np.abs(image.header["pixdim"][1:4].astype(np.float64)),
    }
    if np.allclose(sides["sform"], sides["qform"], rtol=_SPACING_TOLERANCE, atol=0):
        return []
    shown = {name: " × ".join(f"{side:.4g}" for side in three) for name, three in sides.items()}
    both = f"the sform states voxels of {shown['sform']} mm, the qform {shown['qform']} mm"
    return [f"{both}: the sform was used"]


def _simple_itk(path: Path) -> RawVolume:
    import SimpleITK

    detached(path)  # refuses voxels outside of the folder
    SimpleITK.ProcessObject.GlobalWarningDisplayOff()
    reader = SimpleITK.ImageFileReader()
    reader.SetFileName(str(path))
    reader.SetImageIO("NrrdImageIO" if suffix_of(path) in _NRRD else "MetaImageIO")
    reader.ReadImageInformation()
    segments = _segments({key: reader.GetMetaData(key) for key in reader.GetMetaDataKeys()})
    n_layers = reader.GetNumberOfComponents() if segments else 1
    if "complex" in SimpleITK.GetPixelIDValueAsString(reader.GetPixelID()):
        raise _not_integers(path, "complex numbers")
    n_components = reader.GetNumberOfComponents()
    n_values = 1 if segments else n_components
    check_voxels(path, reader.GetSize(), 8 * n_layers, n_values)
    n_bytes = math.prod(reader.GetSize()) * n_components * _value_bytes(reader)
    with _checked(path, n_bytes) as sound:
        reader.SetFileName(str(sound))
        image = reader.Execute()
    values = SimpleITK.GetArrayFromImage(image)  # (Z, Y, X) or (Z, Y, X, layers)
    layers = [values.T]
    if values.ndim == 4:
        layers = [layer.T for layer in np.moveaxis(values, 3, 0)]
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    segments = [segment for segment in segments if segment[1] < len(layers)]
    header = _header(path)
    frame: Frame = "RAS" if _HAS_ORIENTATION.search(header) else None
    volume = RawVolume(layers, _LPS_TO_RAS @ affine, segments=segments, frame=frame)
    if suffix_of(path) in _NRRD:
        _check_directions(header, path)
        _apply_nrrd_unit(volume, header)
    elif not _META_SPACING.search(header):
        _leave_without_unit(volume, "no spacing")
    return volume


def _value_bytes(reader: Any) -> int:
    """Return the size in bytes of a value of a voxel."""
    import SimpleITK

    pixel = SimpleITK.Image([1, 1, 1], reader.GetPixelID(), reader.GetNumberOfComponents())
    return int(pixel.GetSizeOfPixelComponent())


@contextmanager
def _checked(path: Path, n_bytes: int) -> Iterator[Path]:
    """Yield a file that ITK reads rightly, after its compressed data, if any, was read to its end.

    ITK compares no checksum, and fills what is missing with memory that was never written. Without the size of the
    compressed data, which MetaImage need not state, it reads nothing: such a file is written anew with that size.
    """
    header = _header(path)
    files = detached(path)
    data = files[0] if files else path
    start = 0 if files else len(header)
    if suffix_of(path) in _NRRD:
        if re.search(rb"^encoding:\s*(gz|gzip)\s*$", header, re.MULTILINE | re.IGNORECASE):
            check_gzip(data, n_bytes, start=start)
        yield path
        return
    if not _META_COMPRESSED.search(header):
        yield path
        return
    with data.open("rb") as stream:
        stream.seek(start)
        n_packed = check_zlib(stream, data, n_bytes)
        stated = _META_SIZE.search(header)
        if stated is not None:
            if int(stated[1]) != n_packed:
                fault = f"{path}: states {int(stated[1])} compressed bytes, but has {n_packed}"
                raise MeshError(f"{fault}. Export it again.")
            yield path
            return
        stream.seek(start)
        packed = stream.read(n_packed)
    with tempfile.TemporaryDirectory() as folder:
        complete = Path(folder) / "volume.mha"
        lines = _DATA_FILE.sub(b"", header).rstrip()
        size = b"CompressedDataSize = %d" % n_packed
        complete.write_bytes(lines + b"\n" + size + b"\nElementDataFile = LOCAL\n" + packed)
        yield complete


def _check_directions(header: bytes, path: Path) -> None:
    """Raise a MeshError if a NRRD header lacks the direction of an axis: ITK would make one up."""
    if line := re.search(rb"^space directions:(.*)$", header, re.MULTILINE):
        known = [
            vector for vector in re.findall(rb"\(.*?\)", line[1]) if b"nan" not in vector.lower()
        ]
        if len(known) != 3:
            raise MeshError(
                f"{path}: expected directions of three axes in space, got {len(known)}. Export it again."
            )


def _apply_nrrd_unit(volume: RawVolume, header: bytes) -> None:
    """Scale a volume to millimetres by the unit of a NRRD header, which ITK ignores.

    Without a unit, distances of voxels are taken for millimetres, as is usual; without distances there is no unit.
    """
    spacing = _NRRD_SPACING.search(header)
    if spacing is None:
        limits = re.search(rb"^axis ?(mins|maxs):", header, re.MULTILINE | re.IGNORECASE)
        source = "only axis minima and maxima, which are not read" if limits else "no spacing"
        _leave_without_unit(volume, source)
        return
    if re.search(rb"\bnan\b", spacing[0], re.IGNORECASE):
        _leave_without_unit(volume, "a spacing that is no number")
        return
    line = re.search(rb"^(?:space )?units:(.*)$", header, re.MULTILINE | re.IGNORECASE)
    text = line[1].decode("utf-8", "replace") if line else ""
    names = set(re.findall(r'"([^"]+)"', text))
    if not names:
        return
    lengths = {unit_of_length(name) for name in names}
    length = lengths.pop() if len(lengths) == 1 else None
    if length is None:
        volume.unit = None
        shown = ", ".join(repr(name) for name in sorted(names))
        volume.notes.append(f"the header states the units {shown}: lengths have no unit")
        return
    volume.unit_from = "header"
    volume.affine[:3] *= length


def _leave_without_unit(volume: RawVolume, spacing: str) -> None:
    volume.unit = None
    volume.notes.append(f"the header has {spacing}: voxels were taken as 1 × 1 × 1")


def _segments(metadata: dict[str, str]) -> list[tuple[str, int, int]]:
    """Return (name, layer, value) of the segments that 3D Slicer lists in a NRRD header."""
    segments = []
    matches = (re.fullmatch(r"Segment(\d+)_(?:Name|LabelValue)", key) for key in metadata)
    for number in sorted({match[1] for match in matches if match}, key=int):
        value = metadata.get(f"Segment{number}_LabelValue", "").strip()
        # Before 3D Slicer 4.11, each segment had the value 1 in its own layer
        text = metadata.get(f"Segment{number}_Layer", "0" if value else number).strip()
        layer = int(text) if text.isdigit() else 0
        if not value or value.isdigit():
            name = metadata.get(f"Segment{number}_Name", "")
            segments.append((name, layer, int(value or 1)))
    return segments


def detached(path: Path) -> list[Path]:
    """Return the files of voxels that the header of a volume names, if any; a MeshError if outside its folder."""
    if suffix_of(path) not in (*_NRRD, *_META):
        return []
    names = [line.decode("utf-8", "replace") for line in _DATA_FILE.findall(_header(path))]
    for name in names:
        if "/" in name or "\\" in name or name.upper().startswith("LIST"):
            raise MeshError(
                f"{path}: expected voxels in a file of the same folder, got {name!r}. Save it as one file."
            )
    return [path.with_name(name) for name in names if name and name != "LOCAL"]


def _header(path: Path) -> bytes:
    """Read the header of a NRRD or MetaImage file, without the voxels that may follow."""
    end = re.compile(
        rb"\n\r?\n" if suffix_of(path) in _NRRD else rb"^\s*ElementDataFile\s*[=:].*\n",
        re.MULTILINE,
    )
    header = b""
    with path.open("rb") as file:
        while len(header) < _MAX_HEADER:
            block = file.read(1 << 16)
            header += block
            match = end.search(header)
            if match is not None:
                return header[: match.end()]
            if not block:
                break
    return header


def _highdicom(path: Path) -> RawVolume:
    import pydicom
    from highdicom.seg import Segmentation

    dataset = pydicom.dcmread(path)
    modality = dataset.get("Modality", "none")
    if modality == "RTSTRUCT":
        remedy = "Convert it to masks on the grid of its image, with 3D Slicer (SlicerRT) or by"
        convert = f"dcmrtstruct2nii convert -r {path.name} -d FOLDER_OF_THE_IMAGE -o MASKS"
        raise MeshError(f"{path}: RTSTRUCT holds contours and no voxels. {remedy}: {convert}")
    if modality != "SEG":
        raise MeshError(
            f"{path}: expected DICOM of modality SEG, got {modality}. Export the labels as DICOM SEG."
        )
    segmentation = Segmentation.from_dataset(dataset, copy=False)
    geometry = segmentation.get_volume_geometry()
    if geometry is None:
        raise MeshError(
            f"{path}: its slices are not evenly spaced. Resample the segmentation to even slices."
        )
    numbers = [int(number) for number in segmentation.segment_numbers]
    check_voxels(path, geometry.spatial_shape, 4)
    try:
        layers = [np.asarray(segmentation.get_volume(combine_segments=True).array)]
    except (RuntimeError, ValueError):  # segments overlap, or are fractional
        check_voxels(path, geometry.spatial_shape, 8 * len(numbers))
        # The failed attempt keeps tables of the first object locked
        segmentation = Segmentation.from_dataset(pydicom.dcmread(path), copy=False)
        layers = []
        for number in numbers:
            volume = segmentation.get_volume(segment_numbers=[number])
            layers.append(np.asarray(volume.array)[..., 0])
    is_fractional = layers[0].dtype.kind == "f"
    is_separate = is_fractional or len(layers) == len(numbers) > 1
    segments = []
    for layer, number in enumerate(numbers):
        name = str(segmentation.get_segment_description(number).segment_label)
        segments.append((name, layer, 1) if is_separate else (name, 0, number))
    # Axes of the arrays: slices, rows, columns, as in the affine of `geometry`
    affine = _LPS_TO_RAS @ np.array(geometry.affine, dtype=np.float64)
    return RawVolume(layers, affine, segments=segments, unit_from="format")


def _tifffile(path: Path) -> RawVolume:
    import tifffile

    with tifffile.TiffFile(path) as file:
        _check_complete(file, path)
        series = file.series[0]
        axes = series.axes
        dtype = np.dtype(series.dtype)
        if "S" in axes:
            n_samples = series.shape[axes.index("S")]
            check_voxels(path, series.shape[:3], dtype.itemsize, n_samples)
        if dtype.kind not in "biuf":
            raise _not_integers(path, str(dtype))
        shape = list(series.shape)
        if len(shape) > 3:
            shape = [n for n in shape if n > 1]
        pages = [series]
        if len(shape) < 3:  # slices that were written one by one
            layout = (series.shape, series.dtype)
            pages = [page for page in file.series if (page.shape, page.dtype) == layout]
            shape = [len(pages), *shape]
        check_voxels(path, shape, dtype.itemsize)
        try:
            values = series.asarray()
            if len(pages) > 1:
                values = np.stack([page.asarray() for page in pages])
        except ValueError as error:
            if "imagecodecs" not in str(error):
                raise
            import SimpleITK

            values = SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(path)))  # it decodes LZW
        sides, unit = _tiff_sides(file)
    return RawVolume(
        [values.reshape(shape).T],
        np.diag([*sides, 1.0]),
        unit=unit,
        unit_from="header",
        frame=None,
    )


def _check_complete(file: Any, path: Path) -> None:
    """Raise a MeshError if a TIFF file ends before its voxels, or before an entry of its headers such as the spacing.

    Tifffile leaves out what it cannot read.
    """
    n_bytes = path.stat().st_size
    first = file.pages[0]
    file.filehandle.seek(first.offset)
    n_entries = int.from_bytes(
        file.filehandle.read(file.tiff.tagnosize),
        "big" if file.byteorder == ">" else "little",
    )
    is_complete = len(list(first.tags)) == n_entries
    places: set[int] = set()
    for page in file.pages:
        if page.offset in places:
            raise MeshError(f"{path}: its pages form a circle. Copy it again, or export it again.")
        places.add(page.offset)
        for start, size in zip(page.dataoffsets, page.databytecounts, strict=True):
            is_complete &= start + size <= n_bytes
    if not is_complete:
        raise MeshError(f"{path}: the file is cut short. Copy it again, or export it again.")


def _tiff_sides(file: Any) -> tuple[tuple[float, float, float], str | None]:
    """Return the sides (x, y, z) of a voxel by metadata of OME or ImageJ, and their unit: "mm", or None if unknown."""
    if file.ome_metadata:
        known = {}
        for axis in "XYZ":
            size = re.search(rf'\bPhysicalSize{axis}="([\d.eE+-]+)"', file.ome_metadata)
            unit = re.search(rf'\bPhysicalSize{axis}Unit="([^"]*)"', file.ome_metadata)
            scale = unit_of_length(unit[1] if unit else "µm")
            if size and scale:
                known[axis] = float(size[1]) * scale
        if len(known) < 3:
            return (1.0, 1.0, 1.0), None
        return (known["X"], known["Y"], known["Z"]), "mm"
    metadata = file.imagej_metadata
    tags = file.pages[0].tags
    if metadata is None:
        return (1.0, 1.0, 1.0), None
    sides = []
    for name in ("XResolution", "YResolution"):
        n, length = tags[name].value if name in tags else (1, 1)  # ImageJ omits resolutions of 1
        sides.append(length / n if n and length else 1.0)
    sides.append(abs(float(metadata.get("spacing", 1))) or 1.0)
    scale = unit_of_length(str(metadata.get("unit")))
    x, y, z = sides
    if not scale:  # the ratios of the sides still hold
        return (x, y, z), None
    return (scale * x, scale * y, scale * z), "mm"


READERS: dict[str, Callable[[Path], RawVolume]] = {
    **dict.fromkeys((".nii", ".nii.gz", ".mgh", ".mgz"), _nibabel),
    **dict.fromkeys((*_NRRD, *_META), _simple_itk),
    ".dcm": _highdicom,
    ".tif": _tifffile,
    ".tiff": _tifffile,
}
