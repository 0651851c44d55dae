"""Surfaces: files of triangles and polygons, scenes, and archives."""

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
    vtk,
)

FORMATS = (
    off.FORMAT,
    obj.FORMAT,
    ply.FORMAT,
    stl.FORMAT,
    clouds.FORMAT,
    threemf.FORMAT,
    scenes.GLTF,
    scenes.OTHERS,
    vtk.LEGACY,
    vtk.XML,
    brains.GIFTI,
    brains.FREESURFER,
    archives.ARCHIVE,
    archives.COMPRESSED,
)
