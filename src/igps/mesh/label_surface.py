"""The surface of a label: from voxels to a closed triangle mesh without stairs, true to a fraction of a voxel.

A label that has many more voxels than the mesh needs vertices is put on a coarser grid first, as shares of its voxels,
where nothing of it is too thin for that. Then a smooth function that agrees with every voxel (`_label_field`) is
interpolated by cubic splines along the long sides of the voxels, marching cubes take its zero level, quadrics (Garland
and Heckbert 1997) leave as many vertices as are wanted, and the volume is made that of the voxels.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from igps._arrays import Booleans, Floats, Integers, Singles, Surface
from igps.mesh._isosurface import level_surface, simplified, with_volume
from igps.mesh._label_field import PAD, filled_share, smooth_field
from igps.mesh._label_gaps import TOUCHING, with_missed_slices
from igps.mesh._level_set import LEAST, joined, without_bubbles
from igps.mesh.limits import check_grid
from igps.mesh.mesh import MeshError
from igps.mesh.surface import connected, signed_volume, stacked

MAX_VERTICES = 5000
"""Most vertices of a label's surface, by default."""

LEAST_VOXELS = 8
"""Fewest voxels that have a shape."""

_ISLAND = 0.02  # share of the voxels below which a piece apart is dropped
_SPECK = 0.005  # share of the volume below which a piece of the surface is none of the label's
_SPARE = 4  # the grid may make so many times more vertices than are wanted, which are then simplified
_FEWEST = 1500  # vertices that the grid makes at least, if need be by interpolation
_MOST_REFINED = 4
_N_LEVELS = 3
# Radius of the bars between pieces, over the square root of the area. It is more than most cells, so that bars are as
# thick on every grid.
_BAR = 0.02
# Share of a label that may lie where it is too thin for a coarser grid.
_THIN = 0.005


def voxel_surface(
    inside: ArrayLike, affine: ArrayLike | None = None, *, max_vertices: int = MAX_VERTICES, cavities: bool = False,
    joins: bool = False, name: str = "volume",
) -> tuple[Floats, Integers, tuple[str, ...]]:  # fmt: skip
    """The closed, outward surface of the voxels of a body.

    It encloses their volume, has the centres of all voxels on their side unless it was put on a coarser grid, and is
    closed where the body ends at the border of the volume. Voxels that share only a corner are one piece. Holes inside
    are filled.

    Example:
        >>> ball = ((np.indices((24, 24, 24)) - 11.3) ** 2).sum(axis=0) < 10**2
        >>> vertices, faces, _ = voxel_surface(ball)
        >>> bool(abs(np.linalg.norm(vertices - 11.3, axis=1) - 10).max() < 0.4)
        True

    Args:
        inside: (X, Y, Z), true at voxels whose centre lies in the body.
        affine: (4, 4) from indices of voxels to the world; may shear and mirror. None for voxels of side 1.
        max_vertices: about so many vertices at most.
        cavities: hollows of the size of a label, too, get a surface, turned towards the inside.
        joins: pieces become one: a few slices between them are filled, and wider gaps bridged where they are narrowest.
        name: what error messages call the body.

    Returns:
        Vertices (V, 3) in the world, faces (F, 3) of one or several closed pieces, and notes of what was done.

    Raises:
        MeshError: too few voxels, most of them in small pieces, or an affine that is singular.
    """
    mask = np.asarray(inside, dtype=bool)
    if mask.ndim != 3:
        raise MeshError(f"{name}: expected an array of three axes, got shape {mask.shape}.")
    matrix = np.eye(4) if affine is None else np.asarray(affine, dtype=np.float64)
    spacing = checked_spacing(matrix, name)
    n_voxels = int(np.count_nonzero(mask))
    if n_voxels < LEAST_VOXELS:
        few = f"{name}: {n_voxels} voxels, at least {LEAST_VOXELS} expected: they tell no shape."
        raise MeshError(f"{few} Leave it out, or label it on a finer grid.")
    (box,) = ndimage.find_objects(mask.view(np.uint8))
    low = np.array([side.start for side in box], dtype=np.float64)
    notes: list[str] = []
    mask = with_missed_slices(mask[box], notes) if joins else mask[box]
    mask, hollows = _cleaned(mask, notes, LEAST_VOXELS if cavities else None, name)
    share, factor = _coarsened(mask, spacing, max_vertices)
    mask = _with_thick_contacts(share >= 0.5)
    share = np.pad(np.where(mask, np.maximum(share, np.float32(0.5)), share), PAD)
    check_grid(share.size, name)
    sides = spacing * factor / (spacing * factor).min()  # nothing depends on the unit of length
    field = smooth_field(share, sides)
    # Into how many parts each side goes, so that the parts are about equal and make vertices enough.
    n_vertices = _n_vertices(mask, sides)
    finer = min(max(math.ceil(math.sqrt(_FEWEST / n_vertices)), 1), _MOST_REFINED)
    fineness = np.maximum(np.round(finer * sides / sides.min()), 1).astype(np.int64)
    field = _refined(field, share, fineness, sides / fineness)
    n_cells = float(share.sum(dtype=np.float64) * fineness.prod())
    if joins and ndimage.label(mask)[1] > 1:
        n_before = np.count_nonzero(field < 0)
        # A surface has about one and a half vertices for a square of the grid's side.
        field = joined(field.astype(np.float32, copy=False), notes, _BAR * math.sqrt(n_vertices / 1.5) * finer)
        n_cells += np.count_nonzero(field < 0) - n_before
    vertices, faces = _meshed(field, sides / fineness, n_cells * (sides / fineness).prod(), max_vertices, name)
    # Index of the first voxel's centre: that of a block of `factor` voxels lies (factor - 1) / 2 further.
    index = (vertices / sides - PAD) * factor + (factor - 1) / 2 + low
    if np.linalg.det(matrix[:3, :3]) < 0:
        faces = np.ascontiguousarray(faces[:, ::-1])
    surfaces = [(index @ matrix[:3, :3].T + matrix[:3, 3], faces)]
    matrix = matrix @ np.block([[np.eye(3), low[:, None]], [np.zeros(3), 1]])
    for hollow in hollows:
        points, inwards, told = voxel_surface(hollow, matrix, max_vertices=max_vertices, name=name)
        notes += [f"in a cavity: {note}" for note in told]
        surfaces.append((points, inwards[:, ::-1]))
    return *stacked(surfaces), tuple(notes)


def checked_spacing(affine: Floats, name: str) -> Floats:
    """(3,) sides of a voxel, length; a MeshError if the affine is no invertible matrix (4, 4) of finite numbers."""
    if affine.shape != (4, 4) or not np.isfinite(affine).all():
        raise MeshError(f"{name}: affine: expected a finite matrix of shape (4, 4), got {affine.tolist()}.")
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    if not spacing.all() or abs(np.linalg.det(affine[:3, :3] / np.where(spacing, spacing, 1))) < 1e-6:
        singular = f"{name}: the affine is singular, so the voxels have no volume."
        raise MeshError(f"{singular} Write the file again with the spacing and the directions of its axes.")
    return spacing


def _cleaned(mask: Booleans, notes: list[str], least: int | None, name: str) -> tuple[Booleans, list[Booleans]]:
    """Without islands, and with holes filled; and the holes of at least so many voxels, none if None."""
    label, island, size = _islands(mask)
    if len(island):
        lost = int(size[island].sum())
        if 2 * lost >= size.sum():  # lesions
            scattered = f"{name}: {lost / size.sum():.0%} of the voxels lie in {len(island)} pieces apart, each below"
            remedy = 'Take pieces for bodies: LoadOptions(bodies="pieces"), --bodies pieces; or connect them.'
            raise MeshError(f"{scattered} {_ISLAND:.0%} of the label: no one body. {remedy}")
        mask = mask & ~np.isin(label, island)
        pieces = "1 small piece" if len(island) == 1 else f"{len(island)} small pieces"
        notes.append(f"dropped {pieces} apart of {lost} voxels, {lost / size.sum():.1%} of the label")
    # Voxels outside are connected by faces.
    hollow, n_hollow = ndimage.label(np.pad(~mask, 1, constant_values=True))
    if n_hollow < 2:
        return mask, []
    outside, hollow = hollow[0, 0, 0], hollow[1:-1, 1:-1, 1:-1]
    size = np.bincount(hollow.reshape(-1))
    size[[0, outside]] = 0
    kept = [] if least is None else np.flatnonzero(size >= least).tolist()
    if n_filled := int(size.sum() - size[kept].sum()):
        notes.append(f"filled holes of {n_filled} voxels")
    return np.asarray(hollow != outside), [hollow == k for k in kept]


def _islands(mask: Booleans) -> tuple[NDArray[np.int32], Integers, Integers]:
    """The piece of each voxel, from 1; the pieces that are too small to stay; and the voxels of each, of 0 none."""
    label, _ = ndimage.label(mask, TOUCHING)
    size = np.bincount(label.reshape(-1))
    size[0] = 0
    return label, np.nonzero(size < _ISLAND * size.sum())[0][1:], size


def _with_thick_contacts(mask: Booleans) -> Booleans:
    """With voxels added beside edges and corners at which pieces only touch."""
    for _ in range(3):
        label, n_pieces = ndimage.label(mask)
        if n_pieces < 2:
            break
        padded = np.pad(label, 1)
        extra = np.zeros_like(mask)
        for step in np.ndindex(3, 3, 3):
            offset = np.array(step) - 1
            if np.abs(offset).sum() < 2 or tuple(offset) < (0, 0, 0):
                continue
            moved = padded[tuple(slice(1 + d, 1 + d + n) for d, n in zip(offset, mask.shape, strict=True))]
            at = np.argwhere((label > 0) & (moved > 0) & (label != moved))
            for axis in np.nonzero(offset)[0][:-1]:
                at[:, axis] += offset[axis]
                extra[tuple(at.T)] = True
        if not extra.any():
            break
        mask = mask | extra
    return mask


def _n_vertices(mask: Booleans, sides: Floats) -> float:
    """About how many vertices marching cubes make on a grid as fine as the shortest side."""
    layers = [np.moveaxis(mask, axis, 0) for axis in range(3)]
    cuts = np.array([np.count_nonzero(one[1:] != one[:-1]) + np.count_nonzero(one[[0, -1]]) for one in layers])
    return float((cuts * sides.prod() / sides).sum() / sides.min() ** 2)


def _coarsened(mask: Booleans, spacing: Floats, max_vertices: int) -> tuple[Singles, Integers]:
    """Shares of larger voxels, and how many of the given ones each takes along each axis."""
    from skimage.measure import block_reduce

    share, factor = mask.astype(np.float32), np.ones(3, dtype=np.int64)
    n_pieces = ndimage.label(mask, TOUCHING)[1]
    while _n_vertices(mask, spacing * factor) > _SPARE * max_vertices:
        sides = spacing * factor
        halved = sides < 1.5 * sides.min()
        if not _is_thick(mask, halved):
            break
        coarse = block_reduce(share, tuple(np.where(halved, 2, 1)), np.mean)  # of single precision, which is exact
        # Small pieces that hung on a thread go, as they would have without it.
        label, island, size = _islands(coarse >= 0.5)
        if np.count_nonzero(size) - len(island) != n_pieces:
            break
        coarse[np.isin(label, island) & (label > 0)] = 0
        share, factor, mask = coarse, factor * np.where(halved, 2, 1), np.asarray(coarse >= 0.5)
    return share, factor


def _is_thick(mask: Booleans, axes: Booleans) -> bool:
    """Whether hardly any of the body is less than three voxels thick along the axes."""
    core = ndimage.minimum_filter(mask, tuple(np.where(axes, 3, 1)), mode="constant")
    reached = ndimage.maximum_filter(core, tuple(np.where(axes, 5, 1)), mode="constant")
    return bool(np.count_nonzero(mask & ~reached) <= _THIN * np.count_nonzero(mask))


def _refined(field: Floats | Singles, share: Singles, fineness: Integers, sides: Floats) -> Floats | Singles:
    """The field between the centres of the voxels, at the level that gives their volume.

    It is negative between neighbours in the body, which therefore hold together.
    """
    from scipy.interpolate import CubicSpline

    inside = share >= 0.5
    for axis, parts in enumerate(fineness.tolist()):
        if parts > 1:
            index = np.arange(field.shape[axis])
            places = np.linspace(0, index[-1], index[-1] * parts + 1)
            field = CubicSpline(index, field, axis=axis, bc_type="natural")(places)
    volume, least = share.sum(dtype=np.float64) * fineness.prod(), LEAST * float(sides.min())
    for _ in range(_N_LEVELS):
        filled, slope = filled_share(field, float(sides.sum()))
        field -= (volume - filled) / max(slope, 1e-9)
    for axis, parts in enumerate(fineness.tolist()):
        both = inside & np.roll(inside, -1, axis)
        for part in range(parts):
            at = tuple(slice(part if k == axis else 0, None, step) for k, step in enumerate(fineness.tolist()))
            line = field[at]
            line[both[tuple(slice(n) for n in line.shape)] & (line > -least)] = -least
    return field


def _meshed(field: Floats | Singles, sides: Floats, volume: float, max_vertices: int, name: str) -> Surface:
    """The zero level of a field as closed pieces, in the unit of the sides, which are about equal."""
    cell = float(sides.min())
    level = np.where(field < 0, np.minimum(field, -LEAST * cell), np.maximum(field, LEAST * cell)) / cell
    vertices, faces = level_surface(without_bubbles(level.astype(np.float32, copy=False)), name)
    vertices = vertices * (sides / cell)
    pieces = connected(vertices, faces)
    volumes = np.abs([signed_volume(*piece) for piece in pieces])
    parts = []
    # Specks between voxels are none of theirs.
    for own in [piece for piece, size in zip(pieces, volumes, strict=True) if size > _SPECK * volumes.sum()]:
        if signed_volume(*own) < 0:
            own = own[0], own[1][:, ::-1]
        parts.append(simplified(*own, max(round(max_vertices * len(own[0]) / len(vertices)), 50)))
    points, triangles = stacked(parts)
    return with_volume(points, triangles, volume / cell**3) * cell, np.ascontiguousarray(triangles)
