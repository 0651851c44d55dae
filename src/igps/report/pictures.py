"""Simplified surfaces for the page of results: few vertices, quantised, with the barycentroid potential."""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from igps._arrays import Floats
from igps._parallel import run
from igps._progress import Progress
from igps.data.cache import Record
from igps.data.keys import derived_key
from igps.data.pipeline import SignaturePipeline
from igps.failures import Failed
from igps.mesh._collapse_loops import collapse_edges
from igps.mesh.errors import MeshError
from igps.mesh.loading import BodyRef
from igps.mesh.mesh import Frame, Mesh
from igps.report.drawing import axes_of
from igps.report.views import patient_views
from igps.signature.signature import Signature

if TYPE_CHECKING:
    # Loads torch, which workers do without
    from igps.data.dataset import SignatureDataset

logger = logging.getLogger(__name__)

_VERSION = 4  # raise it whenever other surfaces come out
_MAX_VERTICES = 1200  # of one surface
_MIN_VERTICES = 150
# Size of all surfaces of a page, and of one vertex, which has 19 bytes as text in base 64
_MAX_BYTES = 20e6
_BYTES_PER_VERTEX = 19 * 4 / 3
_STEPS = 2**16 - 1  # along each axis of the cube in which vertices are quantised
_ARRAYS = ("vertices", "faces", "potential")
_FEW = 100  # pictures that take less time than worker processes take to start
_N_NEIGHBOURS = 4  # samples whose mean is the potential of a vertex


@dataclass(frozen=True, eq=False)
class PageSurface:
    """The simplified surface of a body on the page."""

    vertices: NDArray[np.uint16]  # (V, 3) in the bounding cube, with axes by `page_axes`
    faces: NDArray[np.uint16]  # (F, 3), counter-clockwise seen from outside
    # (V,) barycentroid potential, 0 at its minimum on the surface, 255 at its maximum
    potential: NDArray[np.uint8]
    potential_range: tuple[float, float]  # minimum and maximum of the potential, no unit
    n_vertices: int  # of the original mesh, as the following fields
    n_faces: int
    area: float  # length²
    volume: float  # length³
    unit: str | None = None  # of length, such as "mm"; None if unknown
    frame: Frame = None  # "RAS" if x points to the patient's left, y up and z to the front

    def packed(self) -> bytes:
        """Return the bytes of vertices, faces and potential, in this order and little-endian."""
        parts = (self.vertices.astype("<u2"), self.faces.astype("<u2"), self.potential)
        return b"".join(part.tobytes() for part in parts)


def fitting_vertices(n_shapes: int) -> int:
    """Return the largest number of vertices of each surface that keeps a page of n shapes below 30 MB."""
    fitting = _MAX_BYTES / _BYTES_PER_VERTEX / max(n_shapes, 1)
    return int(np.clip(fitting, _MIN_VERTICES, _MAX_VERTICES))


def surfaces_of(
    dataset: SignatureDataset, *, n_workers: int | None = None
) -> dict[str, PageSurface]:
    """Return the surfaces of bodies by name, from the cache if possible; a body that fails is logged and left out."""
    n_vertices = fitting_vertices(len(dataset))
    surfaces: dict[str, PageSurface] = {}
    missing: dict[str, BodyRef] = {}
    for name, body in zip(dataset.bodies.names, dataset.bodies, strict=True):
        found = None
        with contextlib.suppress(MeshError):  # which the computation reports
            key = _key(dataset.pipeline, n_vertices, body)
            found = dataset.pipeline.cache("picture").get(key, _decoded)
        if found is None:
            missing[name] = body
        else:
            surfaces[name] = found
    if missing:
        make = partial(_surface_of_body, dataset.pipeline, n_vertices)
        surfaces |= _made(make, missing, n_workers)
    return surfaces


def _made(
    make: Callable[[BodyRef], PageSurface], bodies: Mapping[str, BodyRef], n_workers: int | None
) -> dict[str, PageSurface]:
    """Return the surfaces of bodies by name, made in parallel; a body that fails is logged and left out."""
    names = list(bodies)
    surfaces: dict[str, PageSurface] = {}
    if n_workers is None and len(names) <= _FEW:
        n_workers = 1
    with contextlib.closing(run(make, list(bodies.values()), n_workers=n_workers)) as outcomes:
        for number, outcome in Progress(outcomes, total=len(names), desc="pictures"):
            if isinstance(outcome, Failed):
                logger.warning("%s: no picture: %s", names[number], outcome.reason)
            else:
                surfaces[names[number]] = outcome
    return surfaces


def _surface_of_body(pipeline: SignaturePipeline, n_vertices: int, body: BodyRef) -> PageSurface:
    key = _key(pipeline, n_vertices, body)
    surface = surface_of(pipeline.mesh(body), pipeline.signature(body), n_vertices)
    pipeline.put("picture", key, _encoded(surface))
    return surface


def _key(pipeline: SignaturePipeline, n_vertices: int, body: BodyRef) -> str:
    return derived_key("picture", pipeline.key(body), n_vertices, _VERSION)


def _encoded(surface: PageSurface) -> Record:
    facts = dict(vars(surface))
    arrays = {name: facts.pop(name) for name in _ARRAYS}
    return Record(arrays, {"facts": json.dumps(facts)})


def _decoded(record: Record) -> PageSurface:
    fields: dict[str, Any] = json.loads(record.texts["facts"])
    fields["potential_range"] = tuple(fields["potential_range"])
    fields |= {name: record.arrays[name] for name in _ARRAYS}
    return PageSurface(**fields)


def surface_of(mesh: Mesh, signature: Signature, n_vertices: int) -> PageSurface:
    """Return a surface of `n_vertices` vertices, more if fewer would close handles, with the interpolated potential."""
    vertices = mesh.vertices
    faces = mesh.faces
    if len(vertices) > n_vertices:
        vertices, faces = collapse_edges(vertices, faces, n_vertices)
    if len(vertices) > _STEPS:  # fewer would close handles; a face has two bytes for a corner
        raise MeshError(f"{mesh.name}: too many handles to simplify its surface for the page.")
    samples = signature.surface.points
    squares = np.square(signature.surface.eigenfunctions, dtype=np.float64)
    potential = np.sqrt(squares @ (1 / signature.eigenvalues))
    neighbours = range(1, 1 + min(_N_NEIGHBOURS, len(samples)))
    distances, nearest = cKDTree(samples).query(vertices, neighbours)
    weights = 1 / (distances + 1e-6 * mesh.diagonal)
    values = (weights * potential[nearest]).sum(axis=1) / weights.sum(axis=1)
    low = float(values.min())
    high = float(values.max())
    shades = 255 * (values - low) / ((high - low) or 1)
    rotated = vertices @ page_axes(mesh, samples)
    lowest = rotated.min(axis=0)
    highest = rotated.max(axis=0)
    centre = (lowest + highest) / 2
    in_cube = (rotated - centre) / (highest - lowest).max() + 0.5
    return PageSurface(
        np.rint(_STEPS * in_cube).astype(np.uint16),
        faces.astype(np.uint16),
        np.rint(shades).astype(np.uint8),
        (low, high),
        len(mesh.vertices),
        len(mesh.faces),
        mesh.area,
        mesh.volume,
        mesh.unit,
        mesh.frame,
    )


def page_axes(mesh: Mesh, samples: Floats) -> Floats:
    """Return the axes (3, 3) of a body on the page: the view from the front of a patient, or its principal axes."""
    if mesh.frame == "RAS":
        return patient_views()[0].axes
    return axes_of(samples)
