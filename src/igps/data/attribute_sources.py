"""Sources of attributes: images and grids, values at vertices or in tetrahedra, residues of a molecule.

A value that is not known at some samples is taken from the nearest sample that has one, which the log tells; where more
than a tenth is not known, the body is refused. Not known is what lies outside of an image by more than half a voxel,
what is not finite, and what is so large that it stands for nothing (10¹⁵).
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
from igps.mesh.formats import brains, files_read, images, stamp_of, vertex_values
from igps.mesh.formats.molecules import Molecule, MoleculeBodies, is_structure, molecules_by_part
from igps.mesh.loading import BodyRef, load_mesh, read_surface
from igps.mesh.mesh import MeshError
from igps.mesh.options import LoadOptions
from igps.signature.mean_value import extend
from igps.signature.residue_attributes import RESIDUE_ATTRIBUTES, residue_attribute

logger = logging.getLogger(__name__)

# A value beyond stands for none, such as the 7e18 at the border of some grids.
_LARGEST = 1e15
_MOST_MISSING = 0.1
_TETRAHEDRA = (".vtu",)
# A point this far outside of a tetrahedron, in its heights, belongs to it: rounding, and curved surfaces.
_OUTSIDE = 0.05


@dataclass(frozen=True)
class ResidueAttribute:
    """An attribute of the residues of a molecule, see `igps.signature.residue_attributes.RESIDUE_ATTRIBUTES`."""

    name: str

    def __post_init__(self) -> None:
        check_one_of(RESIDUE_ATTRIBUTES, attribute=self.name)

    def cache_tag(self, body: BodyRef) -> str:
        """The name: the molecule is the body's own file, which the key of its Signature tells."""
        return f"residues 1 {self.name}"

    def __call__(self, body: BodyRef, points: Floats) -> Floats:
        """(P,) or (P, C) at points (P, 3), Å; a MeshError of what is no molecule, or has no such value."""
        if not is_structure(body.path):
            none = f"{body}: has no atoms, which {self.name!r} is known of."
            raise MeshError(f"{none} Give a PDB, mmCIF or PQR file, or choose another descriptor.")
        values = residue_attribute(_molecule(body), points, self.name)
        if np.isnan(values).all():
            raise MeshError(f"{body}: {self.name!r} is known of none of its residues. Choose another descriptor.")
        return fill_missing(values, points, f"{body}: {self.name}")


def _molecule(body: BodyRef) -> Molecule:
    """The molecule that the body is the surface of."""
    part, changed = body.part or "", stamp_of(body.path)
    words = part.split()  # before them may stand the name of one of several structures
    kinds: dict[str, MoleculeBodies] = {"chain": "chains", "assembly": "assembly"}
    for how in (*(kinds[word] for word in kinds if word in words), "models"):
        found = molecules_by_part(body.path, changed, how)
        if part in found:
            return found[part]
    models = list(found.values())  # a body of all of them
    fields = ("positions", "radii", "charges", "residue_positions", "b_factors")
    arrays: dict[str, Any] = {field: np.concatenate([getattr(one, field) for one in models]) for field in fields}
    starts = np.cumsum([0, *(len(one.residue_names) for one in models)])
    arrays["residue_of"] = np.concatenate([one.residue_of + at for one, at in zip(models, starts, strict=False)])
    return replace(models[0], residue_names=tuple(name for one in models for name in one.residue_names), **arrays)


@dataclass(frozen=True)
class FileAttribute(ABC):
    """An attribute from a file that is found by a pattern.

    Args:
        path: in it {stem} stands for the name of the body's file without suffixes, {file} for its path below `root`,
            and {part} for the name of the body in its file. Behind a # stands the name of the array, where the file has
            several. No name that is filled in may lead out of the folder.
        root: from where a relative path leads; the folder of the body's file if None.
    """

    path: str
    root: Path | None = None

    def cache_tag(self, body: BodyRef) -> str:
        """The kind of source, the array's name, and the content of the file; a MeshError where there is none."""
        file, name = self.file(body)
        files = files_read(file)
        return f"{type(self).__name__} 4 {name} {_checksum(*files, stamp=stamp_of(*files))}"

    def __call__(self, body: BodyRef, points: Floats) -> Floats:
        """(P,) or (P, C) at points (P, 3); a MeshError where the file is of no use, or knows too few of them."""
        file, name = self.file(body)
        try:
            values = self.values(body, file, name, points)
        except MemoryError:
            raise
        except MeshError as error:  # of the file, which may be one of thousands
            raise error if str(body) in str(error) else MeshError(f"{body}: its attribute's file {error}") from error
        except Exception as error:  # readers of many formats raise whatever they like
            raise MeshError(
                f"{body}: its attribute's file {file} is not readable ({type(error).__name__}: "
                f"{' '.join(str(error).split())}). Check that it is complete, and of the format that its name tells."
            ) from error
        return fill_missing(values, points, f"{body}: {file}")

    @abstractmethod
    def values(self, body: BodyRef, file: Path, name: str, points: Floats) -> Floats:
        """(P,) or (P, C) at points (P, 3), NaN where they are not known."""

    def files(self, paths: Iterable[Path]) -> set[Path]:
        """See `igps.data.attributes.FromFiles`; those of bodies by {part} are not known before their files are read."""
        found = set()
        for path in paths:
            with contextlib.suppress(MeshError):
                if (file := self.file(BodyRef(path))[0]) != path:
                    found.add(file)
        return found

    def file(self, body: BodyRef) -> tuple[Path, str]:
        """The file of a body, and the name of the array in it, which may be ""; a MeshError where there is none."""
        pattern, _, name = self.path.partition("#")
        root = body.path.parent if self.root is None else self.root
        # By the path as it is written, or else by the real names of its folders. The file may be a link to anywhere
        ways = ((Path(os.path.abspath(body.path)), Path(os.path.abspath(root))),
                (body.path.parent.resolve() / body.path.name, root.resolve()))  # fmt: skip
        below = next((one.relative_to(at).as_posix() for one, at in ways if one.is_relative_to(at)), body.path.name)
        if Path(pattern).is_absolute():
            root = Path(pattern.partition("{")[0]).parent if "{" in pattern else Path(pattern).parent
        words = {"{stem}": body.path.name.partition(".")[0], "{file}": below, "{part}": body.part or ""}
        for word, value in words.items():
            pattern = pattern.replace(word, value)
        path = root / pattern
        if not path.resolve().is_relative_to(root.resolve()):
            raise MeshError(f"{body}: its attribute's file {path} lies outside of {root}. Put it into that folder.")
        if not path.is_file():
            raise MeshError(f"{body}: its attribute's file {path} does not exist. Check the pattern {self.path!r}.")
        return path, name


@lru_cache(maxsize=1000)
def _checksum(*files: Path, stamp: tuple[int, int, int]) -> str:
    """Of the content, remembered: the many bodies of a volume may have one image."""
    return content_digest(*files).hex()


@dataclass(frozen=True)
class ImageAttribute(FileAttribute):
    """Values of an image or grid, linear between the centres of voxels.

    NIfTI, MGH, NRRD and MetaImage in world coordinates (RAS, millimetres); OpenDX, MRC and CCP4 in ångström.
    """

    def values(self, body: BodyRef, file: Path, name: str, points: Floats) -> Floats:
        grid, affine = images.read(file, stamp_of(*files_read(file)))
        at = (brains.in_scanner(body.path, points) - affine[:3, 3]) @ np.linalg.inv(affine[:3, :3]).T
        size = np.array(grid.shape)
        inside = ((at > -0.5) & (at < size - 0.5)).all(axis=1)
        found = np.full(len(points), np.nan)
        if not inside.any():
            return found
        # No more of a large image is changed than what is needed.
        low = np.clip(np.floor(at[inside].min(axis=0)).astype(int), 0, size - 1)
        high = np.clip(np.ceil(at[inside].max(axis=0)).astype(int), 0, size - 1)
        block = grid[tuple(map(slice, low, high + 1))].astype(np.float64)
        known = _is_known(block)
        linear = partial(map_coordinates, coordinates=(at[inside] - low).T, order=1, mode="nearest")
        weight, sums = linear(known.astype(np.float64)), linear(np.where(known, block, 0.0))
        found[inside] = np.where(weight > 0.5, sums / np.maximum(weight, 0.5), np.nan)
        return found


@dataclass(frozen=True)
class VertexAttribute(FileAttribute):
    """Values at the vertices of the body's file, carried inside by mean value coordinates as the eigenfunctions are.

    PLY, VTK (.vtk, .vtp), GIFTI (.shape.gii, .func.gii), FreeSurfer (lh.thickness, lh.curv): one row for each vertex of
    the body as its file has it, or of the whole file where bodies are its pieces or objects. Where the mesh was mended,
    a new vertex has the value of the nearest place of the old surface.
    """

    reading: LoadOptions = LoadOptions()

    def values(self, body: BodyRef, file: Path, name: str, points: Floats) -> Floats:
        import igl

        if file.name.lower().endswith(images.SUFFIXES):  # of a pattern that ends in {file}
            return ImageAttribute(self.path, self.root).values(body, file, name, points)
        raw = read_surface(body.path, self.reading, part=body.part)
        given = vertex_values.chosen(vertex_values.read(file), name, file)
        if len(given) != len(raw.vertices) and self.reading.bodies in ("pieces", "objects"):
            raw = read_surface(body.path, replace(self.reading, bodies="whole"))
        if len(given) != len(raw.vertices):
            counts = f"{len(given)} values, its surface {len(raw.vertices)} vertices"
            raise MeshError(f"{body}: {file} has {counts}. Give the values of this surface.")
        columns = fill_missing(given.reshape(len(given), -1), raw.vertices, str(file))
        mesh = load_mesh(body.path, self.reading, part=body.part)
        if not np.array_equal(mesh.vertices, raw.vertices):
            faces = np.ascontiguousarray(raw.faces)
            _, face, nearest = igl.point_mesh_squared_distance(mesh.vertices, np.ascontiguousarray(raw.vertices), faces)
            corners = [np.ascontiguousarray(raw.vertices[faces[face, i]]) for i in range(3)]
            shares = np.nan_to_num(igl.barycentric_coordinates(np.ascontiguousarray(nearest), *corners), nan=1 / 3)
            columns = np.einsum("vi,vid->vd", shares, columns[faces[face]])
        return extend(mesh.vertices, mesh.faces, columns, points).reshape(len(points), *given.shape[1:])


@dataclass(frozen=True)
class TetAttribute(FileAttribute):
    """Values at the points of a mesh of tetrahedra (.vtu), linear in each."""

    def values(self, body: BodyRef, file: Path, name: str, points: Floats) -> Floats:
        vertices, tetrahedra, arrays = vertex_values.read_tetrahedra(file)
        given = vertex_values.chosen(arrays, name, file)
        corners = vertices[tetrahedra]
        edges = corners[:, 1:] - corners[:, :1]
        solid = np.abs(np.linalg.det(edges)) > 0
        corners, tetrahedra, edges = corners[solid], tetrahedra[solid], edges[solid]
        inverse = np.linalg.inv(edges)
        best, shares, owner = np.full(len(points), -np.inf), np.zeros((len(points), 4)), np.zeros(len(points), int)
        # A point lies within the largest distance of a corner from a centre.
        centres = corners.mean(axis=1)
        tree = cKDTree(centres)
        reach = np.linalg.norm(corners - centres[:, None], axis=2).max()
        for i, near in enumerate(tree.query_ball_point(points, reach * (1 + _OUTSIDE))):
            if near:
                three = np.einsum("td,tde->te", points[i] - corners[near, 0], inverse[near])
                four = np.column_stack([1 - three.sum(axis=1), three])
                one = int(np.argmax(four.min(axis=1)))
                best[i], shares[i], owner[i] = four[one].min(), four[one], near[one]
        found = np.einsum("pi,pi...->p...", shares, given[tetrahedra[owner]].astype(np.float64))
        found[best < -_OUTSIDE] = np.nan
        return found


def attribute_source(path: str, root: Path | None = None) -> AttributeSource:
    """The source that a pattern of paths asks for, by its suffix, see `FileAttribute`; or an attribute of residues."""
    name = path.partition("#")[0].lower()
    if path in RESIDUE_ATTRIBUTES:
        return ResidueAttribute(path)
    if name.endswith(images.SUFFIXES):
        return ImageAttribute(path, root)
    return (TetAttribute if name.endswith(_TETRAHEDRA) else VertexAttribute)(path, root)


def with_load_options(source: AttributeSource, options: LoadOptions) -> AttributeSource:
    """The source for bodies that are read by these options; values at vertices go inside from closed surfaces."""
    closed = replace(options, allow_open=False, mend="auto")
    return replace(source, reading=closed) if isinstance(source, VertexAttribute) else source


def attribute_sources(given: Sequence[str], root: Path | None) -> dict[str, AttributeSource]:
    """Sources by name, of words such as ``ct=images/{stem}.nii.gz``; a ValueError without name or path, or of two."""
    found = {}
    for word in given:
        name, _, path = word.partition("=")
        if not name.isidentifier() or not path or name in found:
            raise ValueError(f"attribute: expected a pattern such as ct=images/{{stem}}.nii.gz, once, got {word!r}.")
        found[name] = attribute_source(path, root)
    return found


def fill_missing(values: Floats, points: Floats, what: str) -> Floats:
    """Values (P,) or (P, C), those that are not known (NaN) taken from the nearest of points (P, 3) that has one.

    How many these are is logged, and of `what`; a MeshError where more than a tenth is not known.
    """
    known = np.asarray(_is_known(values.reshape(len(points), -1)).all(axis=1))
    n_missing = int((~known).sum())
    if n_missing > _MOST_MISSING * len(known):
        low, high = (", ".join(f"{x:.4g}" for x in end) for end in (points.min(axis=0), points.max(axis=0)))
        raise MeshError(
            f"{what}: has no value at {n_missing} of {len(known)} places of the body, which reaches from ({low}) to "
            f"({high}); at most {_MOST_MISSING:.0%} may lack one. Give values of this body, in the coordinates of its "
            "file."
        )
    if n_missing:
        logger.warning("%s: %d of %d values are those of the nearest place", what, n_missing, len(known))
        nearest = cKDTree(points[known]).query(points[~known])[1]
        values = values.copy()
        values[~known] = values[known][nearest]
    return values


def _is_known(values: NDArray[Any]) -> Booleans:
    return np.isfinite(values) & (np.abs(values) < _LARGEST)
