"""PLY: vertices and polygons, or points with normals, as text or bytes."""

from pathlib import Path

from igps.mesh.formats._format import Format, RawBody
from igps.mesh.formats._trimesh import objects
from igps.mesh.options import LoadOptions


def read(path: Path, options: LoadOptions, part: str | None) -> list[RawBody]:
    """The surface, or the cloud of points, of a PLY file."""
    head, end, body = path.read_bytes().partition(b"end_header")
    # trimesh takes the header for UTF-8
    return objects(path, options, head.decode("latin-1").encode("ascii", "replace") + end + body)


FORMAT = Format("PLY", (".ply",), read)
