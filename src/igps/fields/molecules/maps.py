"""Density maps, MRC and CCP4: the body is where the density is at least a threshold."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from scipy import ndimage

from igps._arrays import Singles
from igps._text import counted
from igps.data.grids import Grid
from igps.fields.molecules.molecular_surface import simplified_and_joined
from igps.fields.volumes import images
from igps.fields.volumes._boxes import bounds_of, box_of
from igps.mesh._level_set import MIN_ABS_VALUE, fill_bubbles
from igps.mesh.errors import MeshError, NoBodyError
from igps.mesh.formats import Format, stat_key
from igps.mesh.isosurface import level_surface
from igps.mesh.mesh import Mesh
from igps.mesh.options import LoadOptions
from igps.mesh.raw_body import RawBody, deferred
from igps.mesh.surface import connected, face_areas, signed_volume

_MAX_VERTICES = 5000
_DUST = 0.01  # pieces of less than this share of the largest piece's volume are left out


def map_surface(grid: Grid, threshold: float, name: str) -> Mesh:
    """Return the surface on which a map, in ångström, has the value `threshold`, interpolated linearly.

    Hollows are filled, small pieces are left out, and the others are joined by threads. A body that reaches the border
    of the map is closed there. The area is that of the surface before it was simplified.

    Raises:
        MeshError: no value of the map, or all of them, are at least the threshold.
    """
    inside = grid.values >= threshold
    if not inside.any() or inside.all():
        known = grid.values[np.isfinite(grid.values)].astype(np.float64)
        number = "no value is" if not inside.any() else "all values are"
        raise NoBodyError(
            f"{name}: {number} at least the threshold, {threshold:g}. {_range_of(known)} "
            "Choose another by --threshold."
        )
    notes = [f"density of at least {threshold:g}"]
    low, high = bounds_of(inside)
    if (low == 0).any() or (high != grid.values.shape).any():
        # Beyond the border there is no map, so the body ends half a voxel behind its last one
        notes.append("at the border of the map: closed there")
    start = np.maximum(low - 1, 0)
    values = grid.values[box_of(start, high + 1)]
    field = _in_cells(values.astype(np.float32), threshold)
    _, n_outside = ndimage.label(field > 0)
    if n_outside > 1:
        field = fill_bubbles(field)
        notes.append(f"{counted(n_outside - 1, 'hollow')} inside: filled")
    vertices, faces = level_surface(field, name)
    points = grid.to_world(vertices - 1 + start)
    parts = connected(points, faces)
    volumes = np.abs([signed_volume(*part) for part in parts])
    is_dust = volumes < _DUST * volumes.max()
    if is_dust.any():
        share = volumes[is_dust].sum() / volumes.sum()
        pieces = counted(int(is_dust.sum()), "small piece")
        notes.append(f"left out {pieces}, {share:.1%} of the volume")
    kept = [parts[i] for i in np.flatnonzero(~is_dust)]
    area = sum(float(face_areas(*part).sum()) for part in kept)
    vertices, faces = simplified_and_joined(kept, _MAX_VERTICES, notes)
    return Mesh(vertices, faces, name=name, notes=tuple(notes), unit="Å", fine_area=area)


def _in_cells(values: Singles, threshold: float) -> Singles:
    """Return about the signed distances in cells, negative inside, with a layer outside around them."""
    field = np.where(np.isfinite(values), threshold - values, np.inf)
    is_crossed = np.diff(field > 0, axis=0)
    finite = np.nan_to_num(field, posinf=0.0)
    steps = np.abs(np.diff(finite, axis=0)[is_crossed])
    steps = steps[steps > 0]
    step = float(np.median(steps)) if len(steps) else 1.0
    field = np.clip(field / step, -4, 4)
    smallest = np.where(field <= 0, -MIN_ABS_VALUE, MIN_ABS_VALUE)
    field = np.where(np.abs(field) < MIN_ABS_VALUE, smallest, field)
    # Of the opposite sign where the body is at the border, so that it ends midway
    padded = np.abs(np.pad(field.astype(np.float32), 1, mode="edge"))
    padded[1:-1, 1:-1, 1:-1] = field
    return padded


def _range_of(values: Singles) -> str:
    """Return what the values of a map are, for an error message."""
    if not values.size:
        return "No value is a number."
    mean = values.mean()
    spread = values.std()
    return (
        f"Values go from {values.min():.4g} to {values.max():.4g}; three standard deviations above their mean is "
        f"{mean + 3 * spread:.4g}."
    )


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """Return the body of a map; a MeshError if there is no threshold."""
    if options.threshold is None:
        values = images.read(path, stat_key(path))[0]
        known = values[np.isfinite(values)].astype(np.float64)
        raise MeshError(
            f"{path}: expected a threshold, from which on density is part of the body. {_range_of(known)} "
            "Give it by --threshold, LoadOptions(threshold=...), such as the contour level that EMDB recommends."
        )
    return [deferred(partial(_surface, path, options.threshold), None, "Å")]


def _surface(path: Path, threshold: float) -> Mesh:
    values, affine = images.read(path, stat_key(path))
    return map_surface(Grid(values, affine), threshold, str(path))


FORMAT = Format("a density map", images.MAPS, read, extra="molecules", has_triangles=False)
