"""What files of volumes hold, read by nibabel, SimpleITK, highdicom and tifffile; sizes are checked before."""

import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from igps._arrays import Floats
from igps.mesh.formats.label_names import names_in_extensions, names_in_tags
from igps.mesh.limits import check_fits
from igps.mesh.mesh import MILLIMETRES, MeshError

# Bytes for each voxel beyond those of the file, to hold and count labels.
_BESIDE = 4
_FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])  # from LPS, which DICOM and ITK have, to RAS
_EXPORT = "Export the labels."
_NRRD, _META = (".nrrd", ".nhdr"), (".mha", ".mhd")
_MITK = "org.mitk.multilabel.segmentation.labelgroups"
_MOST_HEADER = 1 << 24
_MGH_FOOTER = 20  # bytes between voxels and tags
# Where a header says that the voxels lie; MetaImage takes ":" for "=", and blanks before it.
_DATA_FILE = re.compile(
    rb"(?:ElementDataFile[ \t]*[=:]|^data ?file:)[ \t]*(?:\./)?(.*?)[ \t]*\r?$", re.MULTILINE | re.IGNORECASE
)


@dataclass
class RawVolume:
    """As it was read: layers (X, Y, Z) of any values, the affine (4, 4), and what the file says of its segments.

    `segments` are (name, layer, value in it), where the file lists them; `names` are of values of a single layer.
    `unit` is "mm", or None of a file that gives no lengths.
    """

    layers: list[NDArray[Any]]
    affine: Floats
    names: dict[int, str] = field(default_factory=dict)
    segments: list[tuple[str, int, int]] = field(default_factory=list)
    unit: str | None = "mm"


def read_raw(path: Path) -> RawVolume:
    """What a file holds, read by the library for its suffix."""
    if (reader := READERS.get(suffix_of(path))) is None:
        raise MeshError(f"{path}: no format of volumes. Convert it to one of {', '.join(READERS)}.")
    return reader(path)


def suffix_of(path: Path) -> str:
    """The suffix in lower case, ".nii.gz" as a whole."""
    name = path.name.lower()
    return ".nii.gz" if name.endswith(".nii.gz") else path.suffix.lower()


def check_voxels(path: str | Path, shape: Sequence[int], n_bytes: int, n_components: int = 1) -> None:
    """Raise a MeshError for other than three axes, a single slice, several values in a voxel, or too many voxels."""
    if n_components != 1:
        raise MeshError(f"{path}: {n_components} values in each voxel, as of colours; one label expected. {_EXPORT}")
    size = [int(n) for n in shape]
    while len(size) > 3 and size[-1] == 1:
        size.pop()
    shown = " × ".join(map(str, size))
    if len(size) != 3:
        axes = f"{path}: an array of {len(size)} axes, {shown}; three expected."
        raise MeshError(f"{axes} Export each volume to a file of its own.")
    if min(size) < 2:
        raise MeshError(f"{path}: {shown} voxels are a single slice, which has no volume. Export the whole stack.")
    remedy = "Crop or resample the volume; if it is smaller, its header is damaged."
    check_fits(math.prod(size) * (n_bytes + _BESIDE), f"{path}: {math.prod(size):,} voxels need", remedy)


def _no_numbers(path: str | Path, what: str) -> MeshError:
    return MeshError(f"{path}: voxels of {what}; whole numbers expected. {_EXPORT}")


def _nibabel(path: Path) -> RawVolume:
    import nibabel

    return of_nibabel(nibabel.load(path), path)


def of_nibabel(image: Any, path: str | Path) -> RawVolume:
    """What an image of nibabel holds; `path` is what messages call it."""
    import nibabel

    dtype = np.dtype(image.get_data_dtype())
    if dtype.fields or dtype.kind not in "biuf":
        raise _no_numbers(path, f"{'colours' if dtype.fields else 'complex numbers'} ({dtype})")
    check_voxels(path, image.shape, max(dtype.itemsize, 1))
    values = np.asanyarray(image.dataobj).reshape(image.shape[:3])
    affine, names = np.array(image.affine, dtype=np.float64), {}
    if isinstance(image, nibabel.Nifti1Pair):  # of which those in one file are some
        affine[:3] *= {1: 1e3, 3: 1e-3}.get(int(image.header["xyzt_units"]) % 8, 1.0)  # metres, micrometres
        names = names_in_extensions(
            bytes(one.get_content_bytes()) if hasattr(one, "get_content_bytes") else str(one.get_content()).encode()
            for one in image.header.extensions
        )
    elif isinstance(image, nibabel.MGHImage) and image.file_map["image"].filename:
        with image.file_map["image"].get_prepare_fileobj("rb") as file:  # nibabel leaves the tags out
            file.seek(image.header.get_footer_offset() + _MGH_FOOTER)
            names = names_in_tags(file.read(_MOST_HEADER))
    return RawVolume([values], affine, names)


def _simple_itk(path: Path) -> RawVolume:
    import SimpleITK

    detached(path)
    SimpleITK.ProcessObject.GlobalWarningDisplayOff()
    reader = SimpleITK.ImageFileReader()
    reader.SetFileName(str(path))
    reader.SetImageIO("NrrdImageIO" if suffix_of(path) in _NRRD else "MetaImageIO")
    reader.ReadImageInformation()
    about = {key: reader.GetMetaData(key) for key in reader.GetMetaDataKeys()}
    segments = _segments(about)
    n_layers = reader.GetNumberOfComponents() if segments else 1
    if "complex" in SimpleITK.GetPixelIDValueAsString(reader.GetPixelID()):
        raise _no_numbers(path, "complex numbers")
    check_voxels(path, reader.GetSize(), 8 * n_layers, 1 if segments else reader.GetNumberOfComponents())
    image = reader.Execute()
    values = SimpleITK.GetArrayFromImage(image)  # (Z, Y, X), and layers last
    layers = [values[..., i].T for i in range(values.shape[3])] if values.ndim == 4 else [values.T]
    affine = np.eye(4)
    affine[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    unit = "mm"
    if suffix_of(path) in _NRRD:
        _check_directions(header := _header(path), path)
        unit = _nrrd_unit(header)
    affine[:3] *= MILLIMETRES.get(unit, 1.0)
    named = [one for one in segments if one[1] < len(layers)]
    return RawVolume(layers, _FLIP @ affine, segments=named, unit="mm" if unit in MILLIMETRES else None)


def _check_directions(header: bytes, path: Path) -> None:
    """Raise a MeshError where a NRRD header leaves out the direction of an axis in space; ITK makes one up."""
    if line := re.search(rb"^space directions:(.*)$", header, re.MULTILINE):
        known = [one for one in re.findall(rb"\(.*?\)", line[1]) if b"nan" not in one.lower()]
        if len(known) != 3:
            raise MeshError(f"{path}: directions of {len(known)} axes in space; three expected. Export it again.")


def _nrrd_unit(header: bytes) -> str:
    """Of length, millimetres where a NRRD header does not say it; ITK passes it over."""
    found = re.search(rb"^(?:space )?units:(.*)$", header, re.MULTILINE)
    words = set(re.findall(r'"([^"]+)"', found[1].decode("utf-8", "replace"))) if found else set()
    return (words.pop() if len(words) == 1 else "of several units") if words else "mm"


def _segments(about: dict[str, str]) -> list[tuple[str, int, int]]:
    """(name, layer, value) of the segments that 3D Slicer or MITK write into a NRRD header."""
    segments = []
    found = (re.fullmatch(r"Segment(\d+)_(?:Name|LabelValue)", key) for key in about)
    for number in sorted({one[1] for one in found if one}, key=int):
        value = about.get(f"Segment{number}_LabelValue", "").strip()
        # Before 4.11 each segment was 1 in a layer of its own
        layer = about.get(f"Segment{number}_Layer", "0" if value else number).strip()
        if not value or value.isdigit():
            name = about.get(f"Segment{number}_Name", "")
            segments.append((name, int(layer) if layer.isdigit() else 0, int(value or 1)))
    for at, group in enumerate(json.loads(about.get(_MITK, "[]"))):
        segments += [(one.get("name", ""), at, int(one["value"])) for one in group["labels"] or ()]
    return segments


def detached(path: Path) -> list[Path]:
    """The file of the voxels, where the header of a volume names another file; a MeshError if outside its folder."""
    if suffix_of(path) not in (*_NRRD, *_META):
        return []
    names = [line.decode("utf-8", "replace") for line in _DATA_FILE.findall(_header(path))]
    for name in names:
        if "/" in name or "\\" in name or name.upper().startswith("LIST"):
            elsewhere = f"{path}: its voxels are said to lie in {name!r}; a file of its own folder expected."
            raise MeshError(f"{elsewhere} Save the volume as one file.")
    return [path.with_name(name) for name in names if name and name != "LOCAL"]


def _header(path: Path) -> bytes:
    """Of a NRRD or MetaImage file, whose voxels may follow."""
    end = re.compile(rb"\n\r?\n" if suffix_of(path) in _NRRD else rb"^\s*ElementDataFile\s*[=:].*\n", re.MULTILINE)
    with path.open("rb") as file:
        header = b""
        while (found := end.search(header)) is None and len(header) < _MOST_HEADER and (more := file.read(1 << 16)):
            header += more
    return header if found is None else header[: found.end()]


def _highdicom(path: Path) -> RawVolume:
    import pydicom
    from highdicom.seg import Segmentation

    dataset = pydicom.dcmread(path)
    if (kind := dataset.get("Modality", "none")) != "SEG":
        other = f"{path}: DICOM of modality {kind}, not SEG; labels expected."
        raise MeshError(f"{other} Export the segmentation as DICOM SEG.")
    segmentation = Segmentation.from_dataset(dataset, copy=False)
    geometry = segmentation.get_volume_geometry()
    if geometry is None:
        raise MeshError(f"{path}: its slices are not evenly spaced. Resample the segmentation to even slices.")
    numbers = [int(number) for number in segmentation.segment_numbers]
    check_voxels(path, geometry.spatial_shape, 4)
    try:
        layers = [np.asarray(segmentation.get_volume(combine_segments=True).array)]
    except (RuntimeError, ValueError):  # segments overlap, or are fractional
        check_voxels(path, geometry.spatial_shape, 8 * len(numbers))
        # What was tried keeps its tables locked
        segmentation = Segmentation.from_dataset(pydicom.dcmread(path), copy=False)
        layers = [np.asarray(segmentation.get_volume(segment_numbers=[n]).array)[..., 0] for n in numbers]
    alone = (len(layers) == len(numbers) and len(numbers) > 1) or layers[0].dtype.kind == "f"
    names = [str(segmentation.get_segment_description(number).segment_label) for number in numbers]
    places = [(at, 1) for at in range(len(numbers))] if alone else [(0, number) for number in numbers]
    segments = [(name, *place) for name, place in zip(names, places, strict=True)]
    # The slices come first, and rows before columns
    return RawVolume(layers, _FLIP @ np.array(geometry.affine, dtype=np.float64), segments=segments)


def _tifffile(path: Path) -> RawVolume:
    import tifffile

    with tifffile.TiffFile(path) as file:
        series = file.series[0]
        axes, dtype = series.axes, np.dtype(series.dtype)
        if "S" in axes:
            check_voxels(path, series.shape[:3], dtype.itemsize, series.shape[axes.index("S")])
        if dtype.kind not in "biuf":
            raise _no_numbers(path, str(dtype))
        shape = [n for n in series.shape if n > 1] if len(series.shape) > 3 else list(series.shape)
        pages = [series]
        if len(shape) < 3:  # written one by one
            pages = [one for one in file.series if (one.shape, one.dtype) == (series.shape, series.dtype)]
            shape = [len(pages), *shape]
        check_voxels(path, shape, dtype.itemsize)
        try:
            values = series.asarray() if len(pages) == 1 else np.stack([one.asarray() for one in pages])
        except ValueError as error:
            if "imagecodecs" not in str(error):
                raise
            import SimpleITK

            values = SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(path)))  # which knows LZW
        sides, unit = _tiff_sides(file)
    return RawVolume([values.reshape(shape).T], np.diag([*sides, 1.0]), unit=unit)


def _tiff_sides(file: Any) -> tuple[tuple[float, float, float], str | None]:
    """Sides of a voxel along x, y and z by OME's or ImageJ's metadata, and their unit: "mm", or None if unknown."""
    if file.ome_metadata:
        found = {}
        for axis in "XYZ":
            size = re.search(rf'\bPhysicalSize{axis}="([\d.eE+-]+)"', file.ome_metadata)
            unit = re.search(rf'\bPhysicalSize{axis}Unit="([^"]*)"', file.ome_metadata)
            scale = MILLIMETRES.get(unit[1] if unit else "µm")
            if size and scale:
                found[axis] = float(size[1]) * scale
        return ((found["X"], found["Y"], found["Z"]), "mm") if len(found) == 3 else ((1.0, 1.0, 1.0), None)
    about, tags = file.imagej_metadata, file.pages[0].tags
    if about is None:
        return (1.0, 1.0, 1.0), None
    # What is 1 ImageJ does not write; without a unit, in pixels, voxels still are as long as they are
    known = [tags[name].value if (name := f"{axis}Resolution") in tags else (1, 1) for axis in "XY"]
    x, y = (per / n if n and per else 1.0 for n, per in known)
    scale = MILLIMETRES.get(str(about.get("unit")))
    factor = scale or 1.0
    return (factor * x, factor * y, factor * (abs(float(about.get("spacing", 1))) or 1.0)), "mm" if scale else None


READERS: dict[str, Callable[[Path], RawVolume]] = {
    **dict.fromkeys((".nii", ".nii.gz", ".mgh", ".mgz"), _nibabel),
    **dict.fromkeys((*_NRRD, *_META), _simple_itk),
    ".dcm": _highdicom,
    ".tif": _tifffile,
    ".tiff": _tifffile,
}
"""The reader of files of each suffix."""
