"""Make a closed triangle mesh without stairs from the voxels of a label, accurate to a fraction of a voxel.

A label with many more voxels than the mesh needs vertices is first put on a coarser grid, unless it is too thin for
that; the coarse voxels hold shares. Then a smooth function that agrees with every voxel (`_label_field`) is
interpolated by cubic splines along the long sides of the voxels. Marching cubes extract its zero level, quadrics
(Garland and Heckbert 1997) reduce the vertices, and the volume is set to that of the voxels.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from igps._arrays import Booleans, Floats, Integers, Singles, Surface
from igps._text import counted
from igps.fields.volumes._boxes import TOUCHING, bounds_of, box_of
from igps.fields.volumes._label_field import PAD, filled_volume, smooth_field
from igps.mesh._level_set import MIN_ABS_VALUE, fill_bubbles, join_pieces
from igps.mesh.errors import MeshError, NoBodyError
from igps.mesh.isosurface import level_surface, restore_volume, simplify_surface
from igps.mesh.limits import check_grid
from igps.mesh.surface import connected, signed_volume, stacked

MAX_VERTICES = 5000
"""Default maximal number of vertices of a label's surface."""

MIN_VOXELS = 8
"""Minimal number of voxels of a label; fewer have no shape."""


class TooFewVoxelsError(NoBodyError):
    """A label of so few voxels that it has no shape."""

    summary = f"of fewer than {MIN_VOXELS} voxels"


_ISLAND = 0.02  # separate pieces of less than this share of the voxels are dropped
_MIN_OPEN_CAVITY = 0.1  # share of the voxels from which an open cavity is noted
_SPECK = 0.005  # pieces of the surface of less than this share of the volume are artefacts between voxels
_MAX_SURPLUS = 4  # the grid may make this many times `max_vertices`, before simplification
_MIN_VERTICES = 1500  # the field is interpolated until the grid makes about as many
_MAX_REFINEMENT = 4
_N_LEVELS = 3  # iterations for the level that gives the volume
# Radius of the bars between pieces, over the square root of the area. It exceeds most cells, so that the thickness of
# bars does not depend on the grid.
_BAR = 0.02
_MAX_THIN = 0.005  # maximal share of a label that may be too thin for a coarser grid


def voxel_surface(
    inside: ArrayLike,
    affine: ArrayLike | None = None,
    *,
    max_vertices: int = MAX_VERTICES,
    cavities: bool = False,
    joins: bool = False,
    name: str = "volume",
    unit: str | None = None,
) -> tuple[Floats, Integers, tuple[str, ...]]:
    """Make a closed, outward oriented surface of the voxels of a body.

    The surface encloses the volume of the voxels. The centres of all voxels are on the right side of it, unless the
    body was put on a coarser grid. A body that reaches the border of the volume is closed there. Voxels that share only
    a corner are connected. Holes inside are filled.

    Example:
        >>> ball = ((np.indices((24, 24, 24)) - 11.3) ** 2).sum(axis=0) < 10**2
        >>> vertices, faces, _ = voxel_surface(ball)
        >>> bool(abs(np.linalg.norm(vertices - 11.3, axis=1) - 10).max() < 0.4)
        True

    Args:
        inside: (X, Y, Z), true at voxels whose centre lies in the body.
        affine: (4, 4) from voxel indices to world coordinates; may shear and mirror. None for voxels of side 1.
        max_vertices: approximate maximal number of vertices.
        cavities: keep hollows of at least `MIN_VOXELS` voxels; they get surfaces that are oriented inward.
        joins: join separate pieces by bars where the gaps are narrowest.
        name: name of the body in error messages.
        unit: unit of length of the world, for notes.

    Returns:
        Vertices (V, 3) in world coordinates, faces (F, 3) of one or several closed pieces, and notes of what was done.

    Raises:
        MeshError: the mask has too few voxels, most voxels lie in small pieces, or the affine is singular.
    """
    mask = np.asarray(inside, dtype=bool)
    if mask.ndim != 3:
        raise MeshError(f"{name}: expected an array of three axes, got shape {mask.shape}.")
    matrix = np.eye(4) if affine is None else np.asarray(affine, dtype=np.float64)
    spacing = voxel_spacing(matrix, name)
    n_voxels = int(np.count_nonzero(mask))
    if n_voxels < MIN_VOXELS:
        few = f"expected at least {MIN_VOXELS} voxels, got {n_voxels}, which have no shape"
        raise TooFewVoxelsError(
            f"{name}: {few}. Leave out the label, or segment it on a finer grid."
        )
    low, high = bounds_of(mask)
    mask = mask[box_of(low, high)]
    notes: list[str] = []
    axes = matrix[:3, :3]
    signed_size = float(np.linalg.det(axes))
    voxel = Voxel(abs(signed_size), unit)
    mask, hollows = _clean(mask, notes, MIN_VOXELS if cavities else None, name, voxel)
    n_open = _n_nearly_enclosed(mask) if cavities else 0
    if n_open > _MIN_OPEN_CAVITY * np.count_nonzero(mask):
        notes.append(
            f"a cavity of about {counted(n_open, 'voxel')} is open through gaps of up to two voxels in its wall"
        )
    share, factor = _coarsen(mask, spacing, max_vertices)
    volume = float(share.sum(dtype=np.float64))  # before contacts are thickened, which adds volume
    mask = _thicken_contacts(share >= 0.5)
    at_least_half = np.maximum(share, np.float32(0.5))
    share = np.pad(np.where(mask, at_least_half, share), PAD)
    check_grid(share.size, name)
    sides = spacing * factor
    sides = sides / sides.min()  # nothing depends on the unit of length
    field = smooth_field(share, sides)
    # Each side is divided so that its parts are about equal and give enough vertices.
    n_vertices = _n_vertices(mask, sides)
    wanted = math.ceil(math.sqrt(_MIN_VERTICES / n_vertices))
    refinement = min(max(wanted, 1), _MAX_REFINEMENT)
    n_parts = np.maximum(np.round(refinement * sides / sides.min()), 1).astype(np.int64)
    cell = sides / n_parts
    field = _refine(field, share, n_parts, cell)
    n_cells = volume * float(n_parts.prod())
    if joins and ndimage.label(mask)[1] > 1:
        n_before = np.count_nonzero(field < 0)
        # A surface has about 1.5 vertices per squared side of a cell.
        radius = _BAR * math.sqrt(n_vertices / 1.5) * refinement
        field = join_pieces(field.astype(np.float32, copy=False), notes, radius)
        n_cells += np.count_nonzero(field < 0) - n_before
    vertices, faces = _mesh(field, cell, n_cells * cell.prod(), max_vertices, name)
    # The centre of a block of `factor` voxels lies (factor - 1) / 2 beyond that of its first voxel.
    index = (vertices / sides - PAD) * factor + (factor - 1) / 2 + low
    if signed_size < 0:
        faces = np.ascontiguousarray(faces[:, ::-1])
    surfaces = [(index @ axes.T + matrix[:3, 3], faces)]
    matrix = matrix @ np.block([[np.eye(3), low[:, None]], [np.zeros(3), 1]])
    for hollow in hollows:
        points, triangles, cavity_notes = voxel_surface(
            hollow, matrix, max_vertices=max_vertices, name=name, unit=unit
        )
        notes += [f"in a cavity: {note}" for note in cavity_notes]
        surfaces.append((points, triangles[:, ::-1]))
    return *stacked(surfaces), tuple(notes)


def voxel_spacing(affine: Floats, name: str) -> Floats:
    """Return the sides (3,) of a voxel, or raise a MeshError unless the affine is a finite invertible matrix (4, 4)."""
    if affine.shape != (4, 4) or not np.isfinite(affine).all():
        raise MeshError(
            f"{name}: affine: expected a finite matrix of shape (4, 4), got {affine.tolist()}."
        )
    axes = affine[:3, :3]
    spacing = np.linalg.norm(axes, axis=0)
    directions = axes / np.where(spacing, spacing, 1)
    if not spacing.all() or abs(np.linalg.det(directions)) < 1e-6:
        raise MeshError(
            f"{name}: the affine is singular. Write the file again with spacing and axes of the voxels."
        )
    return spacing


class Voxel(NamedTuple):
    """The size of a voxel."""

    volume: float
    unit: str | None  # of length

    def amount(self, n: int) -> str:
        """Return a number of voxels with their volume, such as "8 voxels, 216 mm³"."""
        cubed = f" {self.unit}³" if self.unit else ""
        volume = n * self.volume
        shown = f"{volume:,.0f}" if volume >= 1000 else f"{volume:.3g}"
        return f"{counted(n, 'voxel')}, {shown}{cubed}"


def _clean(
    mask: Booleans, notes: list[str], min_hole: int | None, name: str, voxel: Voxel
) -> tuple[Booleans, list[Booleans]]:
    """Drop islands and fill holes. Also return the masks of the holes of at least `min_hole` voxels, none if None."""
    label, island, size = _islands(mask)
    if len(island):
        n_dropped = int(size[island].sum())
        dropped = n_dropped / size.sum()
        if dropped >= 0.5:  # such as lesions
            fault = f"{name}: {dropped:.0%} of the voxels lie in {len(island)} separate pieces"
            remedy = 'Read each piece as a body: LoadOptions(bodies="pieces"), --bodies pieces; or connect the pieces.'
            raise MeshError(
                f"{fault}, each below {_ISLAND:.0%} of the label; one body was expected. {remedy}"
            )
        mask = mask & ~np.isin(label, island)
        pieces = counted(len(island), "small piece")
        amount = voxel.amount(n_dropped)
        notes.append(f"left out {pieces} apart: {amount}, {dropped:.1%} of the label")
    # Voxels outside are connected only across faces.
    hollow, n_hollow = ndimage.label(np.pad(~mask, 1, constant_values=True))
    if n_hollow < 2:
        return mask, []
    outside = hollow[0, 0, 0]
    hollow = hollow[1:-1, 1:-1, 1:-1]
    size = np.bincount(hollow.reshape(-1))
    size[[0, outside]] = 0
    cavities = [] if min_hole is None else np.flatnonzero(size >= min_hole).tolist()
    n_filled = int(size.sum() - size[cavities].sum())
    if n_filled:
        notes.append(f"filled holes: {voxel.amount(n_filled)}")
    return np.asarray(hollow != outside), [hollow == k for k in cavities]


def _n_nearly_enclosed(mask: Booleans) -> int:
    """Count the voxels outside a body that it encloses if it is thickened by one voxel."""
    thick = ndimage.binary_dilation(np.pad(mask, 2), TOUCHING)
    label, _ = ndimage.label(~thick)
    size = np.bincount(label.reshape(-1))
    outside = label[0, 0, 0]
    return int(size[1:].sum() - size[outside])


def _islands(mask: Booleans) -> tuple[NDArray[np.int32], Integers, Integers]:
    """Return the piece of each voxel, from 1; the pieces too small to keep; and the number of voxels of each piece."""
    label, _ = ndimage.label(mask, TOUCHING)
    size = np.bincount(label.reshape(-1))
    size[0] = 0
    small = np.flatnonzero(size < _ISLAND * size.sum())
    return label, small[1:], size  # without the background


def _thicken_contacts(mask: Booleans) -> Booleans:
    """Add voxels where parts touch only at an edge or a corner."""
    for _ in range(3):
        label, n_pieces = ndimage.label(mask)
        if n_pieces < 2:
            break
        padded = np.pad(label, 1)
        added = np.zeros_like(mask)
        for step in np.ndindex(3, 3, 3):
            offset = np.array(step) - 1
            if np.abs(offset).sum() < 2 or tuple(offset) < (0, 0, 0):
                continue
            start = np.array(step)
            moved = padded[box_of(start, start + mask.shape)]
            at = np.argwhere((label > 0) & (moved > 0) & (label != moved))
            for axis in np.nonzero(offset)[0][:-1]:
                at[:, axis] += offset[axis]
                added[tuple(at.T)] = True
        if not added.any():
            break
        mask = mask | added
    return mask


def _n_vertices(mask: Booleans, sides: Floats) -> float:
    """Estimate how many vertices marching cubes make on a grid as fine as the shortest side."""
    area = 0.0
    for axis, side in enumerate(sides):
        layers = np.moveaxis(mask, axis, 0)
        n_inside = np.count_nonzero(layers[1:] != layers[:-1])
        n_at_border = np.count_nonzero(layers[[0, -1]])
        area += (n_inside + n_at_border) * sides.prod() / side
    return float(area / sides.min() ** 2)


def _coarsen(mask: Booleans, spacing: Floats, max_vertices: int) -> tuple[Singles, Integers]:
    """Return the shares of larger voxels, and how many voxels of the mask each takes along each axis."""
    from skimage.measure import block_reduce

    share = mask.astype(np.float32)
    factor = np.ones(3, dtype=np.int64)
    n_pieces = ndimage.label(mask, TOUCHING)[1]
    while _n_vertices(mask, spacing * factor) > _MAX_SURPLUS * max_vertices:
        sides = spacing * factor
        is_halved = sides < 1.5 * sides.min()
        if not _is_thick(mask, is_halved):
            break
        block = np.where(is_halved, 2, 1)
        coarse = block_reduce(share, tuple(block), np.mean)  # exact in single precision
        # Drop small pieces that were connected only by threads too thin for the coarse grid.
        label, island, size = _islands(coarse >= 0.5)
        if np.count_nonzero(size) - len(island) != n_pieces:
            break
        coarse[np.isin(label, island)] = 0
        share = coarse
        factor = factor * block
        mask = np.asarray(coarse >= 0.5)
    return share, factor


def _is_thick(mask: Booleans, axes: Booleans) -> bool:
    """Return whether nearly all of the body is at least three voxels thick along the axes."""
    core = ndimage.minimum_filter(mask, tuple(np.where(axes, 3, 1)), mode="constant")
    is_thick = ndimage.maximum_filter(core, tuple(np.where(axes, 5, 1)), mode="constant")
    n_thin = np.count_nonzero(mask & ~is_thick)
    return bool(n_thin <= _MAX_THIN * np.count_nonzero(mask))


def _refine(
    field: Floats | Singles, share: Singles, n_parts: Integers, sides: Floats
) -> Floats | Singles:
    """Interpolate the field between the centres of the voxels, and shift it to the level that gives their volume."""
    from scipy.interpolate import CubicSpline

    inside = share >= 0.5
    steps = n_parts.tolist()
    for axis, n in enumerate(steps):
        if n > 1:
            index = np.arange(field.shape[axis])
            spline = CubicSpline(index, field, axis=axis, bc_type="natural")
            field = spline(np.linspace(0, index[-1], index[-1] * n + 1))
    volume = share.sum(dtype=np.float64) * n_parts.prod()
    min_abs = MIN_ABS_VALUE * float(sides.min())
    for _ in range(_N_LEVELS):
        filled, slope = filled_volume(field, float(sides.sum()))
        field -= (volume - filled) / max(slope, 1e-9)
    # Make the field negative between neighbours in the body, so that they stay connected.
    for axis, n in enumerate(steps):
        both = inside & np.roll(inside, -1, axis)
        for part in range(n):
            slices = [slice(None, None, step) for step in steps]
            slices[axis] = slice(part, None, n)
            line = field[tuple(slices)]
            joined = both[tuple(map(slice, line.shape))]
            line[joined & (line > -min_abs)] = -min_abs
    return field


def _mesh(
    field: Floats | Singles, sides: Floats, volume: float, max_vertices: int, name: str
) -> Surface:
    """Mesh the zero level of a field as closed pieces of this volume; the sides of a cell are about equal."""
    cell = float(sides.min())
    min_abs = MIN_ABS_VALUE * cell
    bounded = np.where(field < 0, np.minimum(field, -min_abs), np.maximum(field, min_abs))
    level = fill_bubbles((bounded / cell).astype(np.float32, copy=False))
    vertices, faces = level_surface(level, name)
    vertices = vertices * (sides / cell)
    pieces = connected(vertices, faces)
    volumes = [signed_volume(*piece) for piece in pieces]
    speck = _SPECK * np.abs(volumes).sum()
    parts = []
    for (points, triangles), own in zip(pieces, volumes, strict=True):
        if abs(own) <= speck:
            continue
        if own < 0:
            triangles = triangles[:, ::-1]
        n_own = round(max_vertices * len(points) / len(vertices))
        parts.append(simplify_surface(points, triangles, max(n_own, 50)))
    points, triangles = stacked(parts)
    points = restore_volume(points, triangles, volume / cell**3)
    return points * cell, np.ascontiguousarray(triangles)
