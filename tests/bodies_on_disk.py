"""Small meshes, written to files."""

import trimesh


def write_body(path, width, height):
    """A stretched ball of 162 vertices."""
    body = trimesh.creation.icosphere(subdivisions=2)
    body.vertices *= [1.0, width, height]
    path.parent.mkdir(parents=True, exist_ok=True)
    body.export(path)
