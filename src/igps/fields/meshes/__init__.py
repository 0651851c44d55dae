"""Surfaces: files of triangles and polygons, scenes, archives, and values at vertices."""

from igps.data.attribute_sources import SourceKind
from igps.fields.meshes import (
    archives,
    brains,
    clouds,
    obj,
    off,
    ply,
    scenes,
    stl,
    threemf,
    vertex_attributes,
    vtk,
)

FORMATS = (
    off.FORMAT,
    obj.FORMAT,
    ply.FORMAT,
    stl.FORMAT,
    clouds.FORMAT,
    threemf.FORMAT,
    scenes.FORMAT,
    vtk.LEGACY,
    vtk.XML,
    brains.GIFTI,
    brains.FREESURFER,
    archives.ARCHIVE,
    archives.COMPRESSED,
)
ATTRIBUTES = (SourceKind(vertex_attributes.VertexAttribute, suffixes=("",)),)
