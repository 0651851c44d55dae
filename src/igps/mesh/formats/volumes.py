"""Label volumes: NIfTI, NRRD, MetaImage, MGH, DICOM SEG and TIFF stacks; every label is a body.

The world is RAS, x to the patient's right, y to the front and z up, in millimetres. No volume is resampled.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from igps._arrays import Booleans, Floats
from igps.mesh._label_measures import LabelVoxels
from igps.mesh.formats._format import Format, RawBody, faults, made_later
from igps.mesh.formats._volume_files import READERS, RawVolume, detached, of_nibabel, read_raw, suffix_of
from igps.mesh.formats.label_names import cleaned, read_label_names, table_beside
from igps.mesh.label_surface import LEAST_VOXELS, checked_spacing, voxel_surface
from igps.mesh.mending import Cavities, Mending, mend
from igps.mesh.mesh import Mesh, MeshError
from igps.mesh.options import LoadOptions

# More different values are intensities of an image; so are more than a few, if less than a share of neighbours are
# alike: of labels of two voxels' width half are.
_MOST_LABELS, _FEW_LABELS, _ALIKE = 20_000, 50, 0.3
# How far labels may be off whole numbers: NIfTI keeps what was given as numbers with a fraction as scaled integers.
_ROUNDING = 0.01


Box = tuple[slice, slice, slice]


@dataclass(frozen=True)
class LabelBody:
    """A body of a volume: its label and name, its number of voxels, and where in the arrays it lies."""

    label: int
    name: str
    n_voxels: int
    layer: int
    value: int
    box: Box


@dataclass(frozen=True, eq=False)
class LabelVolume:
    """Labels of voxels, and where they are in the world.

    Example:
        >>> labels = np.zeros((20, 20, 20), dtype=np.uint8)
        >>> labels[2:10, 2:18, 2:18], labels[10:18, 2:18, 2:18] = 1, 2
        >>> volume = LabelVolume((labels,), np.diag([1.0, 1.0, 2.0, 1.0]), names={2: "liver"})
        >>> [(body.label, body.name, body.n_voxels) for body in volume.bodies]
        [(1, '1', 2048), (2, 'liver', 2048)]

    A MeshError of no labels, labels that are no whole numbers from 0, names that numbers do not tell apart, or a
    singular affine.
    """

    layers: tuple[NDArray[Any], ...]  # (X, Y, Z) whole numbers, 0 the background; several where segments overlap
    affine: Floats  # (4, 4) from indices of voxels to the world
    name: str = "volume"  # what error messages call it, usually its file
    names: dict[int, str] | None = None  # of labels
    # (label, layer, value in it) of files that list their segments; None for one layer of labels
    segments: tuple[tuple[int, int, int], ...] | None = None
    unit: str | None = "mm"  # of length, None if unknown
    notes: tuple[str, ...] = ()  # what was done to it

    def __post_init__(self) -> None:
        checked_spacing(np.asarray(self.affine, dtype=np.float64), self.name)
        if not self.bodies:
            told = f"{self.name}: no voxel has a label, all are 0"
            told += f" ({'; '.join(self.notes)})" if self.notes else ""
            raise MeshError(f"{told}. Check that the right file was exported.")
        seen: dict[str, int] = {}  # a name may be what another got for its number
        for body in self.bodies:
            if (other := seen.setdefault(body.name, body.label)) != body.label:
                both = f"{self.name}: labels {other} and {body.label} are both named {body.name!r}."
                raise MeshError(f"{both} Rename one, or give names by a table.")

    @cached_property
    def bodies(self) -> tuple[LabelBody, ...]:
        """A body for each label that any voxel has, in ascending order; those of one name with their numbers behind."""
        names, found = self.names or {}, []
        for layer, labels in enumerate(self.layers):
            known = {value: label for label, at, value in self.segments or () if at == layer}
            for value, count, box in _counted(labels, self.name):
                label = known.get(value, value if len(self.layers) == 1 else None)
                if label is not None:
                    found.append(LabelBody(label, names.get(label, str(label)), count, layer, value, box))
        given = Counter(body.name for body in found)
        told = (replace(one, name=f"{one.name} ({one.label})") if given[one.name] > 1 else one for one in found)
        return tuple(sorted(told, key=lambda body: body.label))

    def body(self, part: int | str) -> LabelBody:
        """The body of a label, or of a name; a MeshError with the names that there are, if there is none."""
        named: dict[int | str, LabelBody] = {str(body.label): body for body in self.bodies}
        named |= {key: body for body in self.bodies for key in (body.label, body.name)}  # teeth are named by numbers
        if part in named:
            return named[part]
        known = ", ".join(body.name for body in self.bodies[:10]) + (", …" if len(self.bodies) > 10 else "")
        raise MeshError(f"{self.name}: no label {part!r}. It has {len(self.bodies)}: {known}.")

    def mask(self, part: int | str) -> Booleans:
        """Where the label is, within `LabelBody.box`."""
        body = self.body(part)
        return np.asarray(self.layers[body.layer][body.box] == body.value)

    def voxels(self, part: int | str) -> LabelVoxels:
        """Where the label is, with its place in the grid."""
        low = np.array([side.start for side in self.body(part).box])
        return LabelVoxels(self.mask(part), low, self.layers[0].shape, np.asarray(self.affine, dtype=np.float64))


def read_label_volume(path: str | Path, options: LoadOptions = LoadOptions()) -> LabelVolume:
    """Read a label volume: `.nii`, `.nii.gz`, `.mgh`, `.mgz`, `.nrrd`, `.nhdr`, `.mha`, `.mhd`, `.dcm` (SEG), `.tif`.

    Names of labels come from `options.names`, else from the file (`.seg.nrrd`, DICOM SEG, extensions of NIfTI, tags of
    MGH), else from a table beside it (see `table_beside`); without one a label is its number, and the only label of a
    mask, 1 or 255, has the name of the file. A MeshError of a file that is missing, cut short, too large, or holds no
    labels.
    """
    path = Path(path)
    if not path.is_file():
        raise MeshError(f"{path}: no such file. Check the path.")
    with faults(path, FORMAT):
        raw = read_raw(path)
    return _labelled(raw, str(path), options, path)


def volume_in_memory(
    labels: Any, spacing: Sequence[float] | None = None, name: str = "volume", options: LoadOptions = LoadOptions()
) -> LabelVolume:
    """The volume of an array (X, Y, Z) with the sides of its voxels, in millimetres, or of an image of nibabel."""
    if hasattr(labels, "dataobj"):
        raw = of_nibabel(labels, name)
    else:
        array = np.asarray(labels)
        is_volume = array.ndim == 3 and array.size > 0 and array.dtype.kind in "biuf"
        if not is_volume or (spacing is not None and len(spacing) != 3):
            got = f"{array.dtype} of shape {array.shape}, spacing {spacing}"
            raise MeshError(f"{name}: expected labels of shape (X, Y, Z) and three sides of a voxel, got {got}.")
        raw = RawVolume([array], np.diag([*(spacing or (1, 1, 1)), 1.0]), unit="mm" if spacing else None)
    return _labelled(raw, name, options)


def label_surface(volume: LabelVolume, part: int | str, *, how: Mending = "auto", cavities: Cavities = "fill") -> Mesh:
    """The surface of a label, by its number or name, as a body in the world; see `voxel_surface` and `mend`."""
    body = volume.body(part)
    name = f"{volume.name}#{body.name}"
    affine = np.array(volume.affine, dtype=np.float64)
    affine[:3, 3] += affine[:3, :3] @ [side.start for side in body.box]
    mask, affine = _canonical(volume.mask(part), affine)
    vertices, faces, notes = voxel_surface(mask, affine, cavities=cavities == "keep", joins=how != "never", name=name)
    notes = (*volume.notes, *notes)
    if (volume.names or {}).get(body.label, body.name) != body.name:
        notes = (*notes, "another label has the same name: the number was put behind. Give names by a table")
    return mend(vertices, faces, how=how, cavities=cavities, denoise=False, name=name, notes=notes)


def _canonical(mask: Booleans, affine: Floats) -> tuple[Booleans, Floats]:
    """With axes that run as nearly along x, y and z as they can: formats store the same voxels in different orders."""
    order = linear_sum_assignment(-np.abs(affine[:3, :3]) / np.linalg.norm(affine[:3, :3], axis=0))[1]
    mask, affine = mask.transpose(order), affine[:, [*order, 3]]
    for axis in np.nonzero(np.diag(affine)[:3] < 0)[0]:
        affine[:3, 3] += affine[:3, axis] * (mask.shape[axis] - 1)
        affine[:3, axis] *= -1
        mask = np.flip(mask, int(axis))
    return np.ascontiguousarray(mask), affine


def _labelled(raw: RawVolume, name: str, options: LoadOptions, path: Path | None = None) -> LabelVolume:
    """The labels, with their names by a table, or by the file or what lies beside it, if it is one."""
    notes: list[str] = []
    layers = tuple(_whole_numbers(values, name, options.threshold, notes) for values in raw.layers)
    segments, names = None, raw.names
    if raw.segments:
        # A value may stand for one segment in each layer
        values = [value for _, _, value in raw.segments]
        unique = len(set(values)) == len(values)
        labels = values if unique else list(range(1, len(values) + 1))
        segments = tuple((label, layer, value) for label, (_, layer, value) in zip(labels, raw.segments, strict=True))
        names = cleaned({label: name for label, (name, _, _) in zip(labels, raw.segments, strict=True)})
    if options.names is not None:
        names = read_label_names(options.names)
    elif not names and path is not None:
        names = read_label_names(table) if (table := table_beside(path)) else {}
        label = int(layers[0].max(initial=0))
        is_mask = label in (1, 255) and bool(((layers[0] == 0) | (layers[0] == label)).all())
        if not names and not raw.segments and is_mask:  # is called by its file
            names = {label: path.name[: -len(suffix_of(path))]}
    return LabelVolume(layers, raw.affine, name, names, segments, raw.unit, tuple(dict.fromkeys(notes)))


def _whole_numbers(values: NDArray[Any], name: str, threshold: float, notes: list[str]) -> NDArray[Any]:
    """Labels from 0, of the smallest type; probabilities are cut at the threshold."""
    if values.dtype.kind == "f":
        if n_bad := int(np.count_nonzero(~np.isfinite(values))):
            raise MeshError(f"{name}: {n_bad} voxels are NaN or infinite; labels expected. Set them to 0.")
        slabs = values.T if values.flags.f_contiguous else values  # one by one, a whole copy may be too large
        odd = np.concatenate([np.empty(0), *(one[np.abs(one - np.rint(one)) > _ROUNDING] for one in slabs)])
        # SPM keeps them as bytes times a rounded 1/255, and resampled ones overshoot
        if len(odd) and values.min() >= -_ROUNDING and values.max() <= 1 + _ROUNDING:
            notes.append(f"probabilities: a voxel belongs to the body from {threshold:g} on")
            return (values >= threshold).astype(np.uint8)
        if len(odd):
            raise MeshError(
                f"{name}: {len(odd)} voxels have fractional labels, such as {odd[0]:g}. Resample labels to the nearest "
                "neighbour, or give probabilities between 0 and 1."
            )
    low, high = (int(np.rint(values.min())), int(np.rint(values.max()))) if values.size else (0, 0)
    if low < 0:
        raise MeshError(
            f"{name}: {int(np.count_nonzero(values <= -0.5))} voxels have negative labels, such as {low}; 0 for the "
            "background and positive numbers expected. Is it an image? Export its labels."
        )
    if high >= 2**31:
        raise MeshError(f"{name}: label {high} is too large; below 2³¹ expected. Number the labels anew.")
    if values.dtype.kind != "f":
        return np.asarray(values, dtype=np.min_scalar_type(high))
    return np.rint(values, out=np.empty_like(values, dtype=np.min_scalar_type(high)), casting="unsafe")


def _counted(labels: ArrayLike, name: str) -> Iterable[tuple[int, int, Box]]:
    """The values that occur, without 0, ascending; how often; and the smallest box that holds each."""
    array = np.asarray(labels)
    if array.ndim != 3 or array.dtype.kind not in "biu":
        raise MeshError(f"{name}: expected whole numbers of shape (X, Y, Z), got {array.dtype} of shape {array.shape}.")
    array = array.view(np.uint8) if array.dtype.kind == "b" else array
    if array.size and array.min() < 0:
        raise MeshError(f"{name}: negative labels, such as {array.min()}; numbers from 0 expected.")
    if not array.size or array.max() < 2**16:
        counts = np.zeros(int(array.max(initial=0)) + 1, dtype=np.int64)
        for plane in array:
            counts += np.bincount(plane.ravel(), minlength=len(counts))
        counts[0] = 0
        values, numbered = np.nonzero(counts)[0], array
        counts = counts[values]
    else:
        values, index, counts = np.unique(array, return_inverse=True, return_counts=True)
        start = int(values[0] == 0)
        numbered = index.reshape(array.shape) + (1 - start)
        values, counts = values[start:], counts[start:]
    if len(values) > _MOST_LABELS or (len(values) > _FEW_LABELS and _is_speckled(array, values[counts.argmax()])):
        many = f"{name}: {len(values)} different values, which look like an image and not like labels."
        raise MeshError(f"{many} Export the labels.")
    boxes = [box for box in ndimage.find_objects(numbered) if box is not None]
    return zip(values.tolist(), counts.tolist(), boxes, strict=True)


def _is_speckled(labels: NDArray[Any], most: int) -> bool:
    """Whether hardly any neighbours along x are alike, but for the background and the most frequent value."""
    counted = (labels != 0) & (labels != most)
    pairs = counted[1:] & counted[:-1]
    return bool(np.count_nonzero(pairs & (labels[1:] == labels[:-1])) < _ALIKE * np.count_nonzero(pairs))


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """The surfaces of the labels of a volume; or of all of them together as the whole, or in pieces."""
    return label_bodies(read_label_volume(path, options), options, part)


def label_bodies(volume: LabelVolume, options: LoadOptions, part: str | None = None) -> list[RawBody]:
    """The bodies of a volume, or the one named, by `options`; their surfaces are made later."""
    if options.bodies in ("whole", "pieces"):
        labelled = np.any([layer > 0 for layer in volume.layers], axis=0).astype(np.uint8)
        volume = replace(volume, layers=(labelled,), names=None, segments=None)
        volume = _in_pieces(volume) if options.bodies == "pieces" else volume
    made = partial(label_surface, volume, how=options.mend, cavities=options.cavities)
    if options.bodies == "whole":
        return [made_later(partial(made, 1), None, volume.unit, partial(volume.voxels, 1))]
    names = [body.name for body in volume.bodies] if part is None else [volume.body(part).name]
    return [made_later(partial(made, name), name, volume.unit, partial(volume.voxels, name)) for name in names]


def _in_pieces(volume: LabelVolume) -> LabelVolume:
    """With a label for each piece, in the order of the voxels; without those that are too small to be bodies."""
    label, _ = ndimage.label(volume.layers[0], np.ones((3, 3, 3)))
    small = np.bincount(label.ravel(), minlength=2) < LEAST_VOXELS
    small[0] = False
    if small[1:].all():  # one of them says so
        small[:] = False
    names = {k: f"piece {i}" for i, k in enumerate((np.flatnonzero(~small[1:]) + 1).tolist(), 1)}
    notes = (f"left out {small.sum()} specks",) if small.any() else ()
    return replace(volume, layers=(np.where(small[label], 0, label),), names=names, notes=(*volume.notes, *notes))


def _beside(path: Path, options: LoadOptions) -> list[Path]:
    """The file of the voxels, if it is another one, and the table of names."""
    table = table_beside(path) if options.names is None else Path(options.names)
    return [*detached(path), *([table] if table else [])]


FORMAT = Format("a label volume", tuple(READERS), read, ("labels", "pieces"), extra="volumes", beside=_beside)
