"""Label volumes: NIfTI, NRRD, MetaImage, MGH, DICOM SEG and TIFF stacks; each label is a body.

World coordinates are RAS (x to the patient's right, y to the front, z up) in millimetres. No volume is resampled.
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

from igps._arrays import Booleans, Floats
from igps._text import counted
from igps.fields.volumes._boxes import TOUCHING
from igps.fields.volumes._volume_files import (
    READERS,
    RawVolume,
    detached,
    of_nibabel,
    read_raw,
    suffix_of,
)
from igps.fields.volumes.border import border_notes
from igps.fields.volumes.label_measures import voxel_numbers
from igps.fields.volumes.label_names import BUILT_IN, cleaned, names_table, read_label_names
from igps.fields.volumes.label_surface import MIN_VOXELS, voxel_spacing, voxel_surface
from igps.mesh.errors import MeshError, NoBodyError
from igps.mesh.formats import Format, faults
from igps.mesh.mending import Cavities, Mending, mend
from igps.mesh.mesh import Frame, Mesh
from igps.mesh.options import LoadOptions
from igps.mesh.raw_body import LabelVoxels, RawBody, UnitSource, deferred

# Volumes with more values than _MAX_LABELS are refused as images. So are those with more than _MAX_UNCHECKED values if
# less than a share _MIN_EQUAL of adjacent voxels are equal; labels as thin as two voxels have a share of one half.
_MAX_LABELS = 20_000
_MAX_UNCHECKED = 50
_MIN_EQUAL = 0.3
# Distance of a label from a whole number: NIfTI may store labels as scaled integers
_LABEL_TOLERANCE = 0.01
# Share of its voxels' volume by which a surface may differ without a note
_VOLUME_TOLERANCE = 0.005

Box = tuple[slice, slice, slice]


@dataclass(frozen=True)
class LabelBody:
    """A label of a volume that is a body."""

    label: int
    name: str
    n_voxels: int
    layer: int  # index of the array in `LabelVolume.layers`
    value: int  # of the label in that array
    box: Box  # the smallest that contains the label in that array


@dataclass(frozen=True, eq=False)
class LabelVolume:
    """Labels of voxels, with the affine to the world.

    Example:
        >>> labels = np.zeros((20, 20, 20), dtype=np.uint8)
        >>> labels[2:10, 2:18, 2:18], labels[10:18, 2:18, 2:18] = 1, 2
        >>> volume = LabelVolume((labels,), np.diag([1.0, 1.0, 2.0, 1.0]), names={2: "liver"})
        >>> [(body.label, body.name, body.n_voxels) for body in volume.bodies]
        [(1, '1', 2048), (2, 'liver', 2048)]

    Raises:
        MeshError: no labels, labels other than whole numbers from 0, ambiguous names, or a singular affine.
    """

    # (X, Y, Z) whole numbers, 0 is the background; several if segments overlap
    layers: tuple[NDArray[Any], ...]
    affine: Floats  # (4, 4) from voxel indices to the world
    name: str = "volume"  # used in messages, usually the path
    names: dict[int, str] | None = None  # of labels
    # (label, layer, value in the layer), if the file lists its segments; None for one layer of labels
    segments: tuple[tuple[int, int, int], ...] | None = None
    unit: str | None = "mm"  # of length, None if unknown
    notes: tuple[str, ...] = ()  # remarks on how the volume was read
    frame: Frame = None  # None if it is not known how the patient lies
    unit_from: UnitSource = "default"  # what states the unit

    def __post_init__(self) -> None:
        voxel_spacing(np.asarray(self.affine, dtype=np.float64), self.name)
        if not self.bodies:
            notes = f" ({'; '.join(self.notes)})" if self.notes else ""
            raise NoBodyError(
                f"{self.name}: no voxel has a label, all are 0{notes}. Check the export."
            )
        seen: dict[str, int] = {}  # a given name may equal one that was made distinct by its number
        for body in self.bodies:
            other = seen.setdefault(body.name, body.label)
            if other != body.label:
                both = f"labels {other} and {body.label} are both named {body.name!r}"
                raise MeshError(f"{self.name}: {both}. Rename one, or give names by a table.")

    @cached_property
    def bodies(self) -> tuple[LabelBody, ...]:
        """The bodies of all labels that occur, in ascending order; names that repeat are followed by the label."""
        names = self.names or {}
        bodies = []
        for layer, labels in enumerate(self.layers):
            known = {value: label for label, index, value in self.segments or () if index == layer}
            for value, n_voxels, box in _count_labels(labels, self.name):
                label = known.get(value, value if len(self.layers) == 1 else None)
                if label is not None:
                    name = names.get(label, str(label))
                    bodies.append(LabelBody(label, name, n_voxels, layer, value, box))
        uses = Counter(body.name for body in bodies)
        distinct = []
        for body in bodies:
            if uses[body.name] > 1:
                body = replace(body, name=f"{body.name} ({body.label})")
            distinct.append(body)
        return tuple(sorted(distinct, key=lambda body: body.label))

    def body(self, part: int | str) -> LabelBody:
        """Return the body of a label or name; if there is none, a MeshError lists the names."""
        bodies = self.bodies
        by_key: dict[int | str, LabelBody] = {str(body.label): body for body in bodies}
        # Names win over the numbers of other labels: teeth have numbers as names
        by_key |= {body.label: body for body in bodies}
        by_key |= {body.name: body for body in bodies}
        if part in by_key:
            return by_key[part]
        known = [body.name for body in bodies[:10]]
        if len(bodies) > 10:
            known.append("…")
        raise MeshError(
            f"{self.name}: no label {part!r}. It has {len(bodies)}: {', '.join(known)}."
        )

    def mask(self, part: int | str) -> Booleans:
        """Return the mask of a label within its `LabelBody.box`."""
        body = self.body(part)
        return np.asarray(self.layers[body.layer][body.box] == body.value)

    def voxels(self, part: int | str) -> LabelVoxels:
        """Return the mask of a label with its place in the volume."""
        low = np.array([side.start for side in self.body(part).box])
        affine = np.asarray(self.affine, dtype=np.float64)
        return LabelVoxels(self.mask(part), low, self.layers[0].shape, affine)


def read_label_volume(path: str | Path, options: LoadOptions = LoadOptions()) -> LabelVolume:
    """Read a label volume: `.nii`, `.nii.gz`, `.mgh`, `.mgz`, `.nrrd`, `.nhdr`, `.mha`, `.mhd`, `.dcm` (SEG), `.tif`.

    Names of labels come from the table `options.names`, else from the file (`.seg.nrrd`, DICOM SEG, NIfTI extensions),
    else from a table beside it (see `table_beside`). The only label of a mask, 1 or 255, is then named after the file.
    Other labels are named by the built-in table that `options.names` tells, or else by their numbers.

    Raises:
        MeshError: the file is missing, cut short, too large, or holds no labels.
    """
    path = Path(path)
    if not path.is_file():
        raise MeshError(f"{path}: no such file. Check the path.")
    with faults(path, FORMAT):
        raw = read_raw(path)
    return _labelled(raw, str(path), options, path)


def volume_in_memory(
    labels: Any,
    spacing: Sequence[float] | None = None,
    name: str = "volume",
    options: LoadOptions = LoadOptions(),
) -> LabelVolume:
    """Make a volume of an array (X, Y, Z) and the sides of a voxel, in millimetres, or of an image of nibabel."""
    if hasattr(labels, "dataobj"):
        raw = of_nibabel(labels, name)
    else:
        array = np.asarray(labels)
        is_volume = array.ndim == 3 and array.size > 0 and array.dtype.kind in "biuf"
        if not is_volume or (spacing is not None and len(spacing) != 3):
            got = f"{array.dtype} of shape {array.shape}, spacing {spacing}"
            raise MeshError(
                f"{name}: expected labels of shape (X, Y, Z) and three sides of a voxel, got {got}."
            )
        raw = RawVolume(
            [array],
            np.diag([*(spacing or (1, 1, 1)), 1.0]),
            unit="mm" if spacing else None,
            frame=None,
        )
    return _labelled(raw, name, options)


def label_surface(
    volume: LabelVolume, part: int | str, *, how: Mending = "auto", cavities: Cavities = "fill"
) -> Mesh:
    """Return the surface of a label, by number or name, in world coordinates; see `voxel_surface` and `mend`."""
    body = volume.body(part)
    name = f"{volume.name}#{body.name}"
    affine = np.array(volume.affine, dtype=np.float64)
    affine[:3, 3] += affine[:3, :3] @ [side.start for side in body.box]
    mask, affine = _reoriented(volume.mask(part), affine)
    vertices, faces, notes = voxel_surface(
        mask,
        affine,
        cavities=cavities == "keep",
        joins=how != "never",
        name=name,
        unit=volume.unit,
    )
    mesh = mend(vertices, faces, how=how, cavities=cavities, denoise=False, name=name)
    notes = (*volume.notes, *notes)
    given = voxel_numbers(mask, affine)
    mesh = mesh.annotated(notes=notes, frame=volume.frame, given=given)
    at_border = border_notes(volume.voxels(part), mesh.area, volume.frame)
    mesh = mesh.annotated(notes=at_border)
    of_voxels = given["voxel_volume"]
    surplus = mesh.volume / of_voxels - 1
    if abs(surplus) <= _VOLUME_TOLERANCE:
        return mesh
    note = f"its volume differs by {surplus:+.1%} from that of its voxels, {of_voxels:.6g}"
    return mesh.annotated(notes=(note,))


def _reoriented(mask: Booleans, affine: Floats) -> tuple[Booleans, Floats]:
    """Permute and flip the axes to run as nearly along x, y, z as possible, whatever order a format stores them in."""
    from scipy.optimize import linear_sum_assignment

    axes = affine[:3, :3]
    cosines = np.abs(axes) / np.linalg.norm(axes, axis=0)
    _, order = linear_sum_assignment(-cosines)
    mask = mask.transpose(order)
    affine = affine[:, [*order, 3]]
    for axis in range(3):
        if affine[axis, axis] < 0:
            affine[:3, 3] += affine[:3, axis] * (mask.shape[axis] - 1)
            affine[:3, axis] *= -1
            mask = np.flip(mask, axis)
    return np.ascontiguousarray(mask), affine


def _labelled(
    raw: RawVolume, name: str, options: LoadOptions, path: Path | None = None
) -> LabelVolume:
    """Turn the values of a volume into labels, and find their names; see `read_label_volume`."""
    notes = list(raw.notes)
    layers = tuple(_integer_labels(values, name, options.threshold, notes) for values in raw.layers)
    segments = None
    names = raw.names
    if raw.segments:
        titles, places, values = zip(*raw.segments, strict=True)
        labels = values
        if len(set(values)) < len(values):  # the same one stands for segments in different layers
            labels = tuple(range(1, len(values) + 1))
        segments = tuple(zip(labels, places, values, strict=True))
        names = cleaned(dict(zip(labels, titles, strict=True)))
    is_chosen = options.names is not None and options.names not in BUILT_IN
    if is_chosen or not names:
        names = _names_of(layers, options.names, path, has_segments=bool(raw.segments))
    remarks = tuple(dict.fromkeys(notes))
    return LabelVolume(
        layers,
        raw.affine,
        name,
        names,
        segments,
        raw.unit,
        notes=remarks,
        frame=raw.frame,
        unit_from=raw.unit_from,
    )


def _names_of(
    layers: Sequence[NDArray[Any]], given: str | None, path: Path | None, *, has_segments: bool
) -> dict[int, str]:
    """Return the names of labels by a table; of a mask that no table beside it names, the name of its file."""
    table = names_table(path, given)
    if table is not None and table not in BUILT_IN.values():
        return read_label_names(table)
    values = layers[0]
    label = int(values.max(initial=0))
    if path is not None and label in (1, 255) and not has_segments:
        is_mask = ((values == 0) | (values == label)).all()
        if is_mask:
            return {label: path.name[: -len(suffix_of(path))]}
    return {} if table is None else read_label_names(table)


def _integer_labels(
    values: NDArray[Any], name: str, threshold: float | None, notes: list[str]
) -> NDArray[Any]:
    """Convert values to labels of the smallest unsigned type; probabilities are binarised at the threshold."""
    whole = _whole_numbers(values)
    if whole is not None:
        return whole
    is_float = values.dtype.kind == "f"
    fractions = _fractions(values, name) if is_float else np.empty(0)
    if len(fractions):
        # Probabilities may leave [0, 1]: SPM stores bytes times a rounded 1/255, and resampling overshoots
        if values.min() < -_LABEL_TOLERANCE or values.max() > 1 + _LABEL_TOLERANCE:
            fault = (
                f"{name}: {len(fractions)} voxels have fractional labels, such as {fractions[0]:g}."
            )
            raise MeshError(
                f"{fault} Resample to the nearest neighbour, or give probabilities between 0 and 1."
            )
        threshold = 0.5 if threshold is None else threshold
        if not 0 < threshold <= 1:
            raise MeshError(
                f"{name}: threshold: expected above 0 and at most 1 for probabilities, got {threshold:g}."
            )
        notes.append(f"probabilities: a voxel belongs to the body from {threshold:g} on")
        return (values >= threshold).astype(np.uint8)
    low = int(np.rint(values.min(initial=0)))
    high = int(np.rint(values.max(initial=0)))
    if low < 0:
        n_negative = int(np.count_nonzero(values <= -0.5))
        fault = f"{name}: {n_negative} voxels have negative labels, such as {low}"
        raise MeshError(
            f"{fault}; expected 0 and positive numbers. Export the labels if it is an image."
        )
    if high >= 2**31:
        raise MeshError(
            f"{name}: label {high} is too large, expected less than 2³¹. Renumber the labels."
        )
    smallest_type = np.min_scalar_type(high)
    if not is_float:
        return np.asarray(values, dtype=smallest_type)
    labels = np.empty_like(values, dtype=smallest_type)
    return np.rint(values, out=labels, casting="unsafe")


def _fractions(values: NDArray[Any], name: str) -> NDArray[Any]:
    """Return the values that are no whole numbers; a MeshError if some are not finite."""
    n_bad = int(np.count_nonzero(~np.isfinite(values)))
    if n_bad:
        raise MeshError(
            f"{name}: {n_bad} voxels are NaN or infinite, expected labels. Set them to 0."
        )
    found = [np.empty(0)]
    for slab in values.T if values.flags.f_contiguous else values:  # all at once may be too large
        is_fraction = np.abs(slab - np.rint(slab)) > _LABEL_TOLERANCE
        found.append(slab[is_fraction])
    return np.concatenate(found)


def _whole_numbers(values: NDArray[Any]) -> NDArray[Any] | None:
    """Return values as bytes if they are whole numbers below 256, as nearly all labels are; None if not."""
    if not values.size:
        return None
    if not (values.min() >= 0 and values.max() <= np.iinfo(np.uint8).max):
        return None  # also if some are NaN
    whole = values.astype(np.uint8)
    return whole if np.array_equal(whole, values) else None


def _count_labels(labels: ArrayLike, name: str) -> Iterable[tuple[int, int, Box]]:
    """Return the values that occur except 0, ascending, with their counts and bounding boxes."""
    array = np.asarray(labels)
    if array.ndim != 3 or array.dtype.kind not in "biu":
        raise MeshError(
            f"{name}: expected whole numbers of shape (X, Y, Z), got {array.dtype} of shape {array.shape}."
        )
    if array.dtype.kind == "b":
        array = array.view(np.uint8)
    low = array.min(initial=0)
    high = int(array.max(initial=0))
    if low < 0:
        raise MeshError(f"{name}: expected labels from 0, got {low}. Renumber them.")
    is_reversed = array.flags.f_contiguous
    numbered = array.T if is_reversed else array  # as it lies in memory: half the time
    if high < 2**16:
        counts = np.zeros(high + 1, dtype=np.int64)
        for plane in numbered:
            counts += np.bincount(plane.ravel(), minlength=len(counts))
        counts[0] = 0
        values = np.flatnonzero(counts)
        counts = counts[values]
    else:
        values, index, counts = np.unique(numbered, return_inverse=True, return_counts=True)
        start = int(values[0] == 0)
        values = values[start:]
        counts = counts[start:]
        numbered = index.reshape(numbered.shape) + (1 - start)
    n = len(values)
    if n > _MAX_LABELS or (n > _MAX_UNCHECKED and _is_speckled(array, values[counts.argmax()])):
        raise MeshError(
            f"{name}: {n} values, which look like an image and not like labels. Export the labels."
        )
    boxes = [box for box in ndimage.find_objects(numbered) if box is not None]
    if is_reversed:
        boxes = [box[::-1] for box in boxes]
    return zip(values.tolist(), counts.tolist(), boxes, strict=True)


def _is_speckled(labels: NDArray[Any], most_frequent: int) -> bool:
    """Return whether few neighbours along x are equal, without the background and the most frequent value."""
    is_counted = (labels != 0) & (labels != most_frequent)
    pairs = is_counted[1:] & is_counted[:-1]
    is_equal = labels[1:] == labels[:-1]
    n_equal = np.count_nonzero(pairs & is_equal)
    return bool(n_equal < _MIN_EQUAL * np.count_nonzero(pairs))


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    return label_bodies(read_label_volume(path, options), options, part)


def in_memory(thing: Any, name: str, options: LoadOptions) -> list[RawBody] | None:
    """Return the bodies of labels: an array, a pair (array, spacing), or an image of nibabel; None for others."""
    is_pair = isinstance(thing, tuple) and len(thing) == 2
    labels, spacing = thing if is_pair else (thing, None)
    is_image = hasattr(labels, "dataobj") and hasattr(labels, "affine")
    is_array = isinstance(labels, np.ndarray) and labels.ndim == 3
    if not (is_image or is_array):
        return None
    bodies = label_bodies(volume_in_memory(labels, spacing, name, options), options)
    is_mask = [body.part for body in bodies] == ["1"]
    return [replace(bodies[0], part=None)] if is_mask else bodies


def label_bodies(
    volume: LabelVolume, options: LoadOptions, part: str | None = None
) -> list[RawBody]:
    """Return deferred bodies of a volume: its labels, or all of them as the whole or in pieces, by `options`."""
    if options.bodies in ("whole", "pieces"):
        labelled = np.any([layer > 0 for layer in volume.layers], axis=0).astype(np.uint8)
        volume = replace(volume, layers=(labelled,), names=None, segments=None)
        volume = _in_pieces(volume) if options.bodies == "pieces" else volume
    surface = partial(label_surface, volume, how=options.mend, cavities=options.cavities)
    chosen = volume.bodies if part is None else (volume.body(part),)
    raw_bodies = []
    for body in chosen:
        name = body.name if part is None else part  # a label is found by its number, too
        make = partial(surface, body.name)
        voxels = partial(volume.voxels, body.name)
        raw = deferred(make, name, volume.unit, voxels, volume.unit_from)
        raw_bodies.append(replace(raw, number=str(body.label)))
    return raw_bodies


def _in_pieces(volume: LabelVolume) -> LabelVolume:
    """Give each connected component its own label, in the order of the voxels, without those too small for a body."""
    label, _ = ndimage.label(volume.layers[0], TOUCHING)
    is_speck = np.bincount(label.ravel(), minlength=2) < MIN_VOXELS
    is_speck[0] = False
    if is_speck[1:].all():  # keep them: their error says that they are too small
        is_speck[:] = False
    kept = np.flatnonzero(~is_speck)[1:]  # without the background
    names = {piece: f"piece {number}" for number, piece in enumerate(kept.tolist(), 1)}
    notes = volume.notes
    if is_speck.any():
        notes = (*notes, f"left out {counted(int(is_speck.sum()), 'speck')}")
    layer = np.where(is_speck[label], 0, label)
    return replace(volume, layers=(layer,), names=names, notes=notes)


def _beside(path: Path, options: LoadOptions) -> list[Path]:
    """Return the separate files of the voxels, if any."""
    return detached(path)


FORMAT = Format(
    "a label volume",
    tuple(READERS),
    read,
    ("labels", "pieces"),
    extra="volumes",
    beside=_beside,
    names=names_table,
    in_memory=in_memory,
)
