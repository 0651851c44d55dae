"""Files that are damaged by hand, one fault each, whose counts are known without the code that mends them."""

import sys

import numpy as np
import trimesh
from trimesh.creation import box

N_VERTICES, N_FACES = 162, 320
"""Of the ball that most of the files hold."""


def ball(width=1.0, height=1.0):
    """A stretched ball."""
    body = trimesh.creation.icosphere(subdivisions=2)
    assert len(body.vertices) == N_VERTICES
    assert len(body.faces) == N_FACES
    body.vertices *= [1.0, width, height]
    return body


def write_clean(path, width=1.0, height=1.0):
    """A body."""
    return _written(path, ball(width, height))


def write_soup(path, width=1.0, height=1.0):
    """Every triangle with its own corners, as STL files have them."""
    body = ball(width, height)
    corners = body.vertices[body.faces.ravel()]
    faces = np.arange(3 * N_FACES).reshape(-1, 3)
    return _written(path, trimesh.Trimesh(corners, faces, process=False))


def write_holed(path, width=1.0, height=1.0):
    """Without a vertex and the faces around it: a hole of six edges."""
    body = ball(width, height)
    inner = next(i for i in range(N_VERTICES) if (body.faces == i).sum() == 6)
    body.update_faces((body.faces != inner).all(axis=1))
    body.remove_unreferenced_vertices()
    return _written(path, body)


def write_box(path):
    """A body of eight vertices."""
    return _written(path, box((1, 2, 3)))


def write_crossing(path):
    """Two unit cubes of twelve triangles that go through each other by half."""
    boxes = [box(), box()]
    boxes[1].apply_translation([0.5, 0, 0])
    return _written(path, trimesh.util.concatenate(boxes))


def write_unusable(folder):
    """Files of which nothing can be made; what is said of each, by its name."""
    folder.mkdir(parents=True, exist_ok=True)
    texts = {
        "empty.off": "",
        "empty.stl": "",
        "nothing.off": "OFF\n0 0 0\n",
        "triangle.off": "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
        "line.obj": "v 0 0 0\nv 1 2 3\nv 2 4 6\nv 3 6 9\nf 1 2 3\nf 2 3 4\n",
        "five.xyz": "0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 1 1\n",
        "part.step": "ISO-10303-21;",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    return {
        "empty.off": "the file is empty (0 bytes). Export it again.",
        "empty.stl": "the file is empty (0 bytes). Export it again.",
        "nothing.off": "the file is empty: no vertices and no faces. Export it again.",
        "triangle.off": "expected a closed surface, got a single triangle. Export it again.",
        "line.obj": "expected a surface, but no triangle has an area. Give lines some thickness.",
        "five.xyz": "expected at least 10 points for a surface, got 5. Export or scan more.",
        "part.step": "STEP needs a module that is not installed (import of cascadio halted; None in sys.modules). "
        'Install it: pip install "interior-gps[cad]"; or convert the file to OFF, OBJ, PLY or STL.',
    }


def without_cascadio(monkeypatch):
    """STEP files are those of a format whose module is missing, wherever these tests run."""
    monkeypatch.setitem(sys.modules, "cascadio", None)


def free_edges(path):
    """Edges of one face only, as trimesh counts them."""
    surface = trimesh.load(path, process=False)
    return len(trimesh.grouping.group_rows(surface.edges_sorted, require_count=1))


def _written(path, surface):
    path.parent.mkdir(parents=True, exist_ok=True)
    surface.export(path)
    return path
