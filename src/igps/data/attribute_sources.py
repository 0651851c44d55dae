"""Attribute sources: images and grids, values at vertices or in tetrahedra, residues of a molecule.

A value is missing if the sample lies more than half a voxel outside the image, or if the value is not finite or at
least 10¹⁵ in size. A missing value is replaced by the value of the nearest sample that has one, and the number of
replaced values is logged. If more than a tenth of the values are missing, the body is rejected.
"""

import contextlib
import logging
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from igps._arrays import Booleans, Floats
from igps._parameters import check_one_of
from igps.data.attributes import AttributeSource
from igps.data.cache import content_digest
from igps.fields.meshes import brains, vertex_values
from igps.fields.molecules.molecule import Molecule
from igps.fields.molecules.residue_attributes import RESIDUE_ATTRIBUTES, residue_attribute
from igps.fields.molecules.structures import MoleculeBodies, is_structure, molecules_by_part
from igps.fields.volumes import images
from igps.mesh.errors import MeshError
from igps.mesh.formats import dependencies_of, stat_key
from igps.mesh.loading import BodyRef, load_mesh, read_surface
from igps.mesh.options import LoadOptions
from igps.signature.mean_value import extend

logger = logging.getLogger(__name__)

_MAX_VALUE = 1e15  # larger values are placeholders for missing values, such as 7e18 at the border of some grids
_MAX_MISSING_SHARE = 0.1
_TOLERANCE = 0.05  # share of its height by which a point may lie outside a tetrahedron: rounding, curved surfaces


@dataclass(frozen=True)
class ResidueAttribute:
    """An attribute of the residues of a molecule, one of `RESIDUE_ATTRIBUTES`."""

    name: str

    def __post_init__(self) -> None:
        check_one_of(RESIDUE_ATTRIBUTES, attribute=self.name)

    def cache_tag(self, body: BodyRef) -> str:
        """Return the name. The molecule is the body's own file, which is part of the key of its Signature."""
        return f"residues 1 {self.name}"

    def __call__(self, body: BodyRef, points: Floats) -> Floats:
        """Return values (P,) or (P, C) at points (P, 3), Å; raise a MeshError if the body has no such values."""
        if not is_structure(body.path):
            raise MeshError(
                f"{body}: expected a PDB, mmCIF or PQR file for {self.name!r}. Choose another descriptor."
            )
        values = residue_attribute(_molecule(body), points, self.name)
        if np.isnan(values).all():
            raise MeshError(
                f"{body}: {self.name!r} is defined for none of its residues. Choose another descriptor."
            )
        return fill_missing(values, points, f"{body}: {self.name}")


def _molecule(body: BodyRef) -> Molecule:
    """Return the atoms and residues of a body: of a chain, an assembly or a model, or of all models."""
    part, stamp = body.part or "", stat_key(body.path)
    words = part.split()  # in a file of several structures, the first is the name of a structure
    kinds: dict[str, MoleculeBodies] = {"chain": "chains", "assembly": "assembly"}
    for kind in (*(kinds[word] for word in kinds if word in words), "models"):
        molecules = molecules_by_part(body.path, stamp, kind)
        if part in molecules:
            return molecules[part]
    models = list(molecules.values())
    fields = ("positions", "radii", "charges", "residue_positions", "b_factors")
    arrays: dict[str, Any] = {
        field: np.concatenate([getattr(model, field) for model in models]) for field in fields
    }
    starts = np.cumsum([0, *(len(model.residue_names) for model in models)])
    arrays["residue_of"] = np.concatenate(
        [model.residue_of + i for model, i in zip(models, starts, strict=False)]
    )
    return replace(
        models[0], residue_names=tuple(name for m in models for name in m.residue_names), **arrays
    )


@dataclass(frozen=True)
class FileAttribute(ABC):
    """An attribute from a file whose path is given by a pattern.

    Args:
        path: a pattern, in which {stem} stands for the name of the body's file without suffixes, {file} for its path
            below `root`, and {part} for the name of the body in its file. #NAME at the end selects an array of a file
            with several arrays. The resulting path must lie below `root`.
        root: the folder of relative paths; the folder of the body's file if None.
    """

    path: str
    root: Path | None = None

    def cache_tag(self, body: BodyRef) -> str:
        """Return kind of source, name of the array, and checksum of the file; raise a MeshError if it is missing."""
        file, name = self.file(body)
        files = dependencies_of(file)
        return f"{type(self).__name__} 4 {name} {_checksum(*files, stamp=stat_key(*files))}"

    def __call__(self, body: BodyRef, points: Floats) -> Floats:
        """Return values (P,) or (P, C) at points (P, 3); raise a MeshError if the file cannot be used."""
        file, name = self.file(body)
        try:
            values = self.values(body, file, name, points)
        except MemoryError:
            raise
        except MeshError as error:
            if str(body) in str(error):
                raise
            raise MeshError(
                f"{body}: its attribute file {error}"
            ) from error  # the body may be one of thousands
        except Exception as error:  # the readers of the formats raise exceptions of many types
            raise MeshError(
                f"{body}: its attribute file {file} is not readable ({type(error).__name__}: "
                f"{' '.join(str(error).split())}). Check that it is complete and that its suffix fits its format."
            ) from error
        return fill_missing(values, points, f"{body}: {file}")

    @abstractmethod
    def values(self, body: BodyRef, file: Path, name: str, points: Floats) -> Floats:
        """Return values (P,) or (P, C) at points (P, 3), NaN where they are missing."""

    def files(self, paths: Iterable[Path]) -> set[Path]:
        """Return the attribute files of bodies, see `FileSource`, except for patterns with {part}."""
        files = set()
        for path in paths:
            with contextlib.suppress(MeshError):
                if (file := self.file(BodyRef(path))[0]) != path:
                    files.add(file)
        return files

    def file(self, body: BodyRef) -> tuple[Path, str]:
        """Return the file of a body and the name of its array, or ""; raise a MeshError if there is no such file."""
        pattern, _, name = self.path.partition("#")
        root = body.path.parent if self.root is None else self.root
        # Links in the path of the folder are resolved only if needed. The file itself may be a link to any place
        locations = (
            (Path(os.path.abspath(body.path)), Path(os.path.abspath(root))),
            (body.path.parent.resolve() / body.path.name, root.resolve()),
        )
        relative = (
            file.relative_to(folder) for file, folder in locations if file.is_relative_to(folder)
        )
        below_root = next(relative, Path(body.path.name)).as_posix()
        if Path(pattern).is_absolute():
            root = (
                Path(pattern.partition("{")[0]).parent if "{" in pattern else Path(pattern).parent
            )
        values = {
            "{stem}": body.path.name.partition(".")[0],
            "{file}": below_root,
            "{part}": body.part or "",
        }
        for placeholder, value in values.items():
            pattern = pattern.replace(placeholder, value)
        path = root / pattern
        if not path.resolve().is_relative_to(root.resolve()):
            raise MeshError(
                f"{body}: its attribute file {path} lies outside of {root}. Put it into that folder."
            )
        if not path.is_file():
            raise MeshError(
                f"{body}: its attribute file {path} does not exist. Check the pattern {self.path!r}."
            )
        return path, name


@lru_cache(maxsize=1000)
def _checksum(*files: Path, stamp: tuple[int, int, int]) -> str:
    """Return a checksum of files, cached because the many bodies of a volume may share one image."""
    return content_digest(*files).hex()


@dataclass(frozen=True)
class ImageAttribute(FileAttribute):
    """Values of an image or grid, interpolated linearly between the centres of voxels.

    NIfTI, MGH, NRRD and MetaImage are in world coordinates (RAS, millimetres); OpenDX, MRC and CCP4 in ångström.
    """

    def values(self, body: BodyRef, file: Path, name: str, points: Floats) -> Floats:
        grid, affine = images.read(file, stat_key(*dependencies_of(file)))
        indices = (brains.in_scanner(body.path, points) - affine[:3, 3]) @ np.linalg.inv(
            affine[:3, :3]
        ).T
        size = np.array(grid.shape)
        inside = ((indices > -0.5) & (indices < size - 0.5)).all(axis=1)
        values = np.full(len(points), np.nan)
        if not inside.any():
            return values
        # A large image is converted only where it is needed
        low = np.clip(np.floor(indices[inside].min(axis=0)).astype(int), 0, size - 1)
        high = np.clip(np.ceil(indices[inside].max(axis=0)).astype(int), 0, size - 1)
        block = grid[tuple(map(slice, low, high + 1))].astype(np.float64)
        known = _is_known(block)
        interpolate = partial(
            map_coordinates, coordinates=(indices[inside] - low).T, order=1, mode="nearest"
        )
        weight, sums = (
            interpolate(known.astype(np.float64)),
            interpolate(np.where(known, block, 0.0)),
        )
        values[inside] = np.where(weight > 0.5, sums / np.maximum(weight, 0.5), np.nan)
        return values


@dataclass(frozen=True)
class VertexAttribute(FileAttribute):
    """Values at the vertices of the body's file, extended to the interior by mean value coordinates.

    Formats are PLY, VTK (.vtk, .vtp), GIFTI (.shape.gii, .func.gii) and FreeSurfer (lh.thickness, lh.curv). The file
    has one value for each vertex of the body before mending, or of the whole file if bodies are its pieces or objects.
    A vertex that mending created gets the value at the nearest point of the original surface.
    """

    reading: LoadOptions = LoadOptions()

    def values(self, body: BodyRef, file: Path, name: str, points: Floats) -> Floats:
        import igl

        if file.name.lower().endswith(
            images.SUFFIXES
        ):  # if the pattern ends in {file}, the suffix is known only here
            return ImageAttribute(self.path, self.root).values(body, file, name, points)
        raw = read_surface(body.path, self.reading, part=body.part)
        values = vertex_values.chosen(vertex_values.read(file), name, file)
        if len(values) != (n_own := len(raw.vertices)) and self.reading.bodies in (
            "pieces",
            "objects",
        ):
            raw = read_surface(body.path, replace(self.reading, bodies="whole"))
        if len(values) != len(raw.vertices):
            whole = f" ({len(raw.vertices)} in the whole file)" * (len(raw.vertices) != n_own)
            raise MeshError(
                f"{body}: {file} has {len(values)} values for {n_own} vertices{whole}. Give one for each."
            )
        columns = fill_missing(values.reshape(len(values), -1), raw.vertices, str(file))
        mesh = load_mesh(body.path, self.reading, part=body.part)
        if not np.array_equal(mesh.vertices, raw.vertices):
            faces = np.ascontiguousarray(raw.faces)
            _, face, nearest = igl.point_mesh_squared_distance(
                mesh.vertices, np.ascontiguousarray(raw.vertices), faces
            )
            corners = [np.ascontiguousarray(raw.vertices[faces[face, i]]) for i in range(3)]
            weights = np.nan_to_num(
                igl.barycentric_coordinates(np.ascontiguousarray(nearest), *corners), nan=1 / 3
            )
            columns = np.einsum("vi,vid->vd", weights, columns[faces[face]])
        return extend(mesh.vertices, mesh.faces, columns, points).reshape(
            len(points), *values.shape[1:]
        )


@dataclass(frozen=True)
class TetAttribute(FileAttribute):
    """Values at the vertices of a tetrahedral mesh (.vtu), interpolated linearly in each tetrahedron."""

    def values(self, body: BodyRef, file: Path, name: str, points: Floats) -> Floats:
        vertices, tetrahedra, arrays = vertex_values.read_tetrahedra(file)
        at_vertices = vertex_values.chosen(arrays, name, file)
        corners = vertices[tetrahedra]
        edges = corners[:, 1:] - corners[:, :1]
        is_solid = np.abs(np.linalg.det(edges)) > 0
        corners, tetrahedra, edges = corners[is_solid], tetrahedra[is_solid], edges[is_solid]
        inverse = np.linalg.inv(edges)
        # Tetrahedron of each point, barycentric coordinates in it, and the smallest of them, which is negative outside
        n = len(points)
        owner, weights, smallest = np.zeros(n, int), np.zeros((n, 4)), np.full(n, -np.inf)
        # No point of a tetrahedron is farther from its centre than a corner
        centres = corners.mean(axis=1)
        radius = np.linalg.norm(corners - centres[:, None], axis=2).max()
        for i, near in enumerate(
            cKDTree(centres).query_ball_point(points, radius * (1 + _TOLERANCE))
        ):
            if near:
                last_three = np.einsum("td,tde->te", points[i] - corners[near, 0], inverse[near])
                barycentric = np.column_stack([1 - last_three.sum(axis=1), last_three])
                best = int(np.argmax(barycentric.min(axis=1)))
                smallest[i], weights[i], owner[i] = (
                    barycentric[best].min(),
                    barycentric[best],
                    near[best],
                )
        values = np.einsum(
            "pi,pi...->p...", weights, at_vertices[tetrahedra[owner]].astype(np.float64)
        )
        values[smallest < -_TOLERANCE] = np.nan
        return values


def attribute_source(path: str, root: Path | None = None) -> AttributeSource:
    """Return the source for the name of a residue attribute, or for a pattern of paths by its suffix."""
    name = path.partition("#")[0].lower()
    if path in RESIDUE_ATTRIBUTES:
        return ResidueAttribute(path)
    if name.endswith(images.SUFFIXES):
        return ImageAttribute(path, root)
    return (TetAttribute if name.endswith(".vtu") else VertexAttribute)(path, root)


def with_load_options(source: AttributeSource, options: LoadOptions) -> AttributeSource:
    """Return a `VertexAttribute` with these options, but with open surfaces closed; return others unchanged."""
    closed = replace(options, allow_open=False, mend="auto")
    return replace(source, reading=closed) if isinstance(source, VertexAttribute) else source


def attribute_sources(definitions: Sequence[str], root: Path | None) -> dict[str, AttributeSource]:
    """Parse definitions such as ``ct=images/{stem}.nii.gz`` into sources by name; raise a ValueError if invalid."""
    sources = {}
    for text in definitions:
        name, _, path = text.partition("=")
        if not name.isidentifier() or not path or name in sources:
            raise ValueError(
                f"attribute: expected a new name and a path, as in ct={{stem}}.nii.gz, got {text!r}."
            )
        sources[name] = attribute_source(path, root)
    return sources


def fill_missing(values: Floats, points: Floats, label: str) -> Floats:
    """Return values (P,) or (P, C) at points (P, 3), with missing values replaced by those of the nearest point.

    The number of replaced values is logged. A MeshError is raised if more than a tenth of the values are missing.
    """
    known = np.asarray(_is_known(values.reshape(len(points), -1)).all(axis=1))
    n_missing = int((~known).sum())
    if n_missing > _MAX_MISSING_SHARE * len(known):
        low, high = (
            ", ".join(f"{x:.4g}" for x in end) for end in (points.min(axis=0), points.max(axis=0))
        )
        raise MeshError(
            f"{label}: has no value at {n_missing} of {len(known)} points of the body, which extends from ({low}) to "
            f"({high}); at most {_MAX_MISSING_SHARE:.0%} of the points may lack a value. Give values of this body, in "
            "the coordinates of its file."
        )
    if n_missing:
        logger.warning(
            "%s: %d of %d values were taken from the nearest point", label, n_missing, len(known)
        )
        nearest = cKDTree(points[known]).query(points[~known])[1]
        values = values.copy()
        values[~known] = values[known][nearest]
    return values


def _is_known(values: NDArray[Any]) -> Booleans:
    return np.isfinite(values) & (np.abs(values) < _MAX_VALUE)
