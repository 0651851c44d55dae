"""Small valid meshes, written in six formats and broken in random ways; a seed and a number repeat each file."""

from __future__ import annotations

import io
import re
import struct
import zipfile
from dataclasses import dataclass
from functools import cache

import numpy as np
import trimesh
from numpy.typing import NDArray

Generator = np.random.Generator
Surface = tuple[NDArray[np.float64], NDArray[np.int64]]

FORMATS = ("off", "obj", "ply", "stl", "glb", "3mf")
_TEXT_PLY, _TEXT_STL = "ply_ascii", "stl_ascii"
_WORDS = (
    "nan",
    "inf",
    "-inf",
    "1e309",
    "-1e309",
    "1e300",
    "1e-300",
    "1e-320",
    "0",
    "-0",
    "-1",
    "1",
    "3",
    "4",
    "1e999",
    "2147483647",
    "2147483648",
    "-2147483648",
    "9223372036854775808",
    "99999999999999999999999",
    "0.5",
    "0x10",
    "1,5",
    "",
    "abc",
    "é",
    "#",
    "//",
    "1/1/1",
    "-1/-1",
    "\x00",
    "\n",
    "OFF",
    "v",
    "f",
    "end_header",
    "1_0",
    "١",
)
_WORDS_OF_FOUR = (
    *(
        struct.pack("<f", x)
        for x in (np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, 3e38, -3e38, 1e-38, 1e-45)
    ),
    *(struct.pack("<i", x) for x in (-1, 0, 1, 2, 3, 255, 65535, 2**31 - 1, -(2**31))),
)


@dataclass(frozen=True)
class Broken:
    """A file that may or may not be a mesh.

    Args:
        name: of the file.
        content: of the file.
        arrays: vertices and faces in the file; None if the file itself was broken afterwards.
        story: the faults, in words.
    """

    name: str
    content: bytes
    arrays: Surface | None
    story: str


@cache
def valid_surfaces():
    """Closed surfaces of a few hundred vertices, of genus 0 and 1, smooth and with edges, none of them symmetric."""
    box = trimesh.creation.box(extents=(1.0, 0.7, 0.4))
    for _ in range(3):
        box = box.subdivide()
    meshes = [
        trimesh.creation.icosphere(subdivisions=2),
        trimesh.creation.torus(1.0, 0.35, major_sections=20, minor_sections=9),
        trimesh.creation.capsule(height=1.5, radius=0.4, count=[12, 12]),
        trimesh.creation.annulus(0.4, 0.9, 0.6, sections=16).subdivide(),
        trimesh.creation.cylinder(0.4, 1.6, sections=24).subdivide(),
        box,
    ]
    surfaces = []
    for number, mesh in enumerate(meshes):
        mesh.merge_vertices()
        x, y, z = np.asarray(mesh.vertices).T
        # A smooth and injective map, so that nothing is symmetric and eigenvalues are distinct
        bent = np.stack(
            [
                1.3 * x + 0.11 * y * z,
                y + 0.13 * x * x + 0.05 * z,
                0.8 * z + 0.09 * np.sin(2 * x + number),
            ],
            1,
        )
        surfaces.append((bent, np.asarray(mesh.faces, dtype=np.int64)))
    return tuple(surfaces)


def broken_mesh(seed, number):
    """Make the file of a seed and a number: a valid surface in a random format with one to three faults.

    One file in twenty has no fault.
    """
    generator = np.random.default_rng([seed, number])
    surfaces = valid_surfaces()
    vertices, faces = (np.array(array) for array in surfaces[generator.integers(len(surfaces))])
    suffix = str(generator.choice(FORMATS))
    story = []
    n_faults = 0 if generator.random() < 0.05 else int(generator.choice([1, 1, 1, 2, 3]))
    # A third of all faults are faults of the file.
    candidates = [*_ON_ARRAYS, *3 * list(_ON_FILES)]
    faults = [candidates[i] for i in generator.integers(len(candidates), size=n_faults)]
    with np.errstate(all="ignore"):
        for fault in (fault for fault in faults if fault in _ON_ARRAYS):
            vertices, faces = _ON_ARRAYS[fault](generator, vertices, faces)
            story.append(fault)
        kind = (
            f"{suffix}_ascii" if suffix in ("ply", "stl") and generator.random() < 0.5 else suffix
        )
        content = written(vertices, faces, kind)
    file_faults = [fault for fault in faults if fault in _ON_FILES]
    for fault in file_faults:
        break_file = _ON_FILES[fault]
        if suffix == "3mf":
            content = _in_archive(break_file, generator, content)
        else:
            content = break_file(generator, content, suffix)
        story.append(fault)
    arrays = None if file_faults else (vertices, faces)
    return Broken(
        f"{number:06d}.{suffix}", content, arrays, f"{kind}: {', '.join(story) or 'nothing'}"
    )


def broken_bytes(generator, content):
    """Break a file of any format, and return the name of the fault and the broken content."""
    fault = str(generator.choice(["bytes", "tokens"]))
    return fault, _ON_FILES[fault](generator, content, "")


def written(vertices, faces, kind):
    """Write arrays in a format, even invalid ones, which no exporter would write."""
    points = [" ".join(repr(float(x)) for x in row) for row in vertices]
    if kind == "off":
        rows = [
            f"OFF\n{len(vertices)} {len(faces)} 0",
            *points,
            *(f"3 {a} {b} {c}" for a, b, c in faces),
        ]
        return ("\n".join(rows) + "\n").encode()
    if kind == "obj":
        rows = [
            *(f"v {point}" for point in points),
            *(f"f {a} {b} {c}" for a, b, c in faces + 1),
        ]
        return ("\n".join(rows) + "\n").encode()
    if kind in ("ply", _TEXT_PLY):
        return _ply(vertices, faces, points, kind == _TEXT_PLY)
    if kind in ("stl", _TEXT_STL):
        return _stl(vertices, faces, kind == _TEXT_STL)
    return _glb(vertices, faces) if kind == "glb" else _3mf(points, faces)


def _ply(vertices, faces, points, text):
    header = (
        f"ply\nformat {'ascii' if text else 'binary_little_endian'} 1.0\nelement vertex {len(vertices)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    if text:
        return (
            header
            + ("\n".join([*points, *(f"3 {a} {b} {c}" for a, b, c in faces)]) + "\n").encode()
        )
    corners = np.empty(
        len(faces),
        dtype=[("n", "u1"), ("corners", "<i4", 3)],
    )
    corners["n"] = 3
    corners["corners"] = faces
    return header + np.asarray(vertices, "<f8").tobytes() + corners.tobytes()


def _stl(vertices, faces, text):
    corners = vertices[np.clip(faces, 0, len(vertices) - 1)]
    if text:
        rows = ["solid campaign"]
        for triangle in corners:
            rows += ["facet normal 0 0 0", "outer loop"]
            rows += ["vertex " + " ".join(repr(float(x)) for x in corner) for corner in triangle]
            rows += ["endloop", "endfacet"]
        return ("\n".join([*rows, "endsolid campaign"]) + "\n").encode()
    records = np.zeros(
        len(faces),
        dtype=[
            ("normal", "<f4", 3),
            ("corners", "<f4", (3, 3)),
            ("colour", "<u2"),
        ],
    )
    records["corners"] = corners
    return b"campaign".ljust(80) + struct.pack("<I", len(faces)) + records.tobytes()


def _glb(vertices, faces):
    positions = np.asarray(vertices, "<f4")
    indices = np.asarray(faces % 2**32, "<u4")
    low, high = (np.nan_to_num(f(positions, axis=0)).tolist() for f in (np.min, np.max))
    text = (
        '{"asset":{"version":"2.0"},"scene":0,"scenes":[{"nodes":[0]}],"nodes":[{"mesh":0}],'
        '"meshes":[{"primitives":[{"attributes":{"POSITION":0},"indices":1}]}],'
        f'"buffers":[{{"byteLength":{positions.nbytes + indices.nbytes}}}],'
        f'"bufferViews":[{{"buffer":0,"byteOffset":0,"byteLength":{positions.nbytes}}},'
        f'{{"buffer":0,"byteOffset":{positions.nbytes},"byteLength":{indices.nbytes}}}],'
        f'"accessors":[{{"bufferView":0,"componentType":5126,"count":{len(positions)},"type":"VEC3",'
        f'"min":{low},"max":{high}}},'
        f'{{"bufferView":1,"componentType":5125,"count":{indices.size},"type":"SCALAR"}}]}}'
    ).encode()
    text += b" " * (-len(text) % 4)
    body = positions.tobytes() + indices.tobytes()
    chunks = (
        struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(body), b"BIN\0")
        + body
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _3mf(points, faces):
    vertices = "".join('<vertex x="{}" y="{}" z="{}"/>'.format(*point.split()) for point in points)
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in faces)
    model = (
        '<?xml version="1.0" encoding="UTF-8"?>'
        '<model unit="millimeter" xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources>'
        f'<object id="1" type="model"><mesh><vertices>{vertices}</vertices><triangles>{triangles}</triangles></mesh>'
        '</object></resources><build><item objectid="1"/></build></model>'
    )
    return _archive(model.encode())


def _archive(model):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo("3D/3dmodel.model"), model)
    return stream.getvalue()


def _in_archive(fault, generator, content):
    """Break the model within the archive, so that the archive's checksum does not reveal every fault."""
    if generator.random() < 0.2:
        return fault(generator, content, "zip")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            model = archive.read("3D/3dmodel.model")
    except (
        zipfile.BadZipFile,
        KeyError,
        OSError,
        ValueError,
        EOFError,
        RuntimeError,
        zipfile.zlib.error,
    ):
        return fault(generator, content, "zip")  # the archive is broken already
    return _archive(fault(generator, model, "3mf"))


# Faults of the file.


def _bytes(generator, content, suffix):
    data = bytearray(content)
    if not data:
        return content
    at = int(generator.integers(len(data)))
    run = int(
        min(
            2 ** generator.integers(0, 10),
            len(data) - at,
        )
    )
    choice = generator.integers(7)
    if choice == 0:
        for i in generator.integers(len(data), size=generator.integers(1, 20)):
            data[i] ^= 1 << int(generator.integers(8))
    elif choice == 1:
        del data[at : at + run]
    elif choice == 2:
        del data[at:]
    elif choice == 3:
        data[at:at] = generator.integers(0, 256, run, dtype=np.uint8).tobytes()
    elif choice == 4:
        data[at:at] = data[at : at + run]
    elif choice == 5:
        data[at : at + run] = bytes(run)
    else:
        data[at : at + run] = generator.integers(0, 256, run, dtype=np.uint8).tobytes()
    return bytes(data)


def _tokens(generator, content, suffix):
    if _is_text(content):
        tokens = list(re.finditer(rb"[-+.0-9eE]+|[a-zA-Z_]+", content))
        if not tokens:
            return content
        chosen = generator.choice(
            len(tokens),
            size=min(
                int(generator.integers(1, 4)),
                len(tokens),
            ),
            replace=False,
        )
        for i in sorted(chosen, reverse=True):
            word = str(generator.choice(_WORDS)).encode()
            content = content[: tokens[i].start()] + word + content[tokens[i].end() :]
        return content
    data = bytearray(content)
    for _ in range(generator.integers(1, 4)):
        if len(data) >= 4:
            at = int(generator.integers(len(data) - 3))
            data[at : at + 4] = _WORDS_OF_FOUR[generator.integers(len(_WORDS_OF_FOUR))]
    return bytes(data)


def _counts(generator, content, suffix):
    """Change a declared count, or delete or repeat lines."""
    replacement = generator.choice(
        [
            -1,
            0,
            1,
            2,
            7,
            100,
            10**6,
            2**31 - 1,
            2**32 - 1,
        ]
    )
    wrong = int(replacement) if generator.random() < 0.5 else None
    if suffix == "stl" and not content.startswith(b"solid") and len(content) >= 84:
        (count,) = struct.unpack("<I", content[80:84])
        count = (
            wrong % 2**32
            if wrong is not None
            else max(
                count + int(generator.integers(-3, 4)),
                0,
            )
        )
        return content[:80] + struct.pack("<I", count) + content[84:]
    patterns = {
        "off": rb"(?<=OFF\n)(\d+)|(?<= )(\d+)(?= 0\n)",
        "ply": rb"(?<=vertex )(\d+)|(?<=face )(\d+)",
        "glb": rb'(?<="count":)(\d+)|(?<="byteLength":)(\d+)|(?<="byteOffset":)(\d+)|(?<="componentType":)(\d+)',
    }
    if suffix in patterns:
        matches = list(re.finditer(patterns[suffix], content[:4000]))
        if matches:
            match = matches[generator.integers(len(matches))]
            value = (
                wrong if wrong is not None else int(match.group()) + int(generator.integers(-3, 4))
            )
            word = str(value).encode()
            # GLB files declare the lengths of their chunks. Padding keeps these lengths correct.
            if suffix == "glb":
                word = word[: len(match.group())].ljust(len(match.group()))
            return content[: match.start()] + word + content[match.end() :]
    lines = content.splitlines(keepends=True) if suffix != "3mf" else re.split(rb"(?=<)", content)
    for _ in range(generator.integers(1, 4)):
        if lines:
            at = int(generator.integers(len(lines)))
            if generator.random() < 0.5:
                del lines[at]
            else:
                lines.insert(at, lines[at])
    return b"".join(lines)


def _is_text(content):
    return (
        b"\0" not in content[:2000]
        and b"binary" not in content[:100]
        and not content.startswith(b"PK")
    )


# Faults of the surface.


def _flip(generator, vertices, faces):
    chosen = generator.random(len(faces)) < generator.choice([0.01, 0.5, 1.0])
    faces[chosen] = faces[chosen, ::-1]
    return vertices, faces


def _hole(generator, vertices, faces):
    return vertices, np.delete(
        faces,
        generator.integers(
            len(faces),
            size=generator.choice([1, 2, 20]),
        ),
        axis=0,
    )


def _double(generator, vertices, faces):
    copies = faces[generator.integers(len(faces), size=generator.choice([1, 5]))]
    return vertices, np.concatenate(
        [faces, copies[:, ::-1] if generator.random() < 0.5 else copies]
    )


def _glue(generator, vertices, faces):
    """Merge two vertices, which makes a pinch or an edge of more than two faces."""
    a, b = generator.integers(len(vertices), size=2)
    faces[faces == a] = b
    return vertices, faces


def _fin(generator, vertices, faces):
    return vertices, np.concatenate(
        [
            faces,
            generator.integers(len(vertices), size=(generator.choice([1, 3]), 3)),
        ]
    )


def _index(generator, vertices, faces):
    wrong = int(
        generator.choice(
            [
                -1,
                len(vertices),
                10**6,
                2**31 - 1,
                -(2**31),
                int(faces.max()),
            ]
        )
    )
    faces[generator.integers(len(faces)), generator.integers(3)] = wrong
    return vertices, faces


def _strays(generator, vertices, faces):
    return np.concatenate(
        [
            vertices,
            generator.normal(size=(generator.choice([1, 5]), 3)),
        ]
    ), faces


def _twins(generator, vertices, faces):
    """Add a second body, outside, touching or inside."""
    offset = generator.choice([0.0, 0.1, 5.0])
    factor = generator.choice([1.0, 0.5, 1e-3])
    return np.concatenate([vertices, factor * vertices + offset]), np.concatenate(
        [faces, faces + len(vertices)]
    )


def _seam(generator, vertices, faces):
    """Give some or all faces separate vertices."""
    chosen = generator.random(len(faces)) < generator.choice([0.02, 0.5, 1.0])
    # An earlier fault may have made invalid indices
    chosen &= ((faces >= 0) & (faces < len(vertices))).all(axis=1)
    corners = faces[chosen].ravel()
    split = faces.copy()
    split[chosen] = len(vertices) + np.arange(len(corners)).reshape(-1, 3)
    return np.concatenate([vertices, vertices[corners]]), split


def _order(generator, vertices, faces):
    order = generator.permutation(len(vertices))
    position = np.argsort(order)
    is_valid = (faces >= 0) & (faces < len(vertices))
    return vertices[order], np.where(
        is_valid,
        position[np.where(is_valid, faces, 0)],
        faces,
    )


def _not_finite(generator, vertices, faces):
    vertices[generator.integers(len(vertices)), generator.integers(3)] = generator.choice(
        [np.nan, np.inf, -np.inf]
    )
    return vertices, faces


def _spike(generator, vertices, faces):
    exponent = generator.choice(
        [
            generator.uniform(0, 3),
            generator.uniform(-300, 300),
        ]
    )
    vertices[generator.integers(len(vertices)), generator.integers(3)] = (
        generator.choice([-1, 1]) * 10**exponent
    )
    return vertices, faces


def _noise(generator, vertices, faces):
    return vertices + generator.normal(size=vertices.shape) * 10 ** generator.uniform(-8, 0), faces


def _flat(generator, vertices, faces):
    vertices[:, generator.integers(3)] *= generator.choice([0.0, 1e-12, 1e-6, 1e-3, 1e-1])
    return vertices, faces


def _slivers(generator, vertices, faces):
    """Move some vertices to a neighbour, or almost to it."""
    for face in faces[generator.integers(len(faces), size=generator.choice([1, 10]))]:
        corners = face[(face >= 0) & (face < len(vertices))]
        if len(corners) > 1:
            share = generator.choice([1.0, 1 - 1e-15, 1 - 1e-9, 1 - 1e-5, 0.99])
            vertices[corners[0]] += share * (vertices[corners[1]] - vertices[corners[0]])
    return vertices, faces


def _scale(generator, vertices, faces):
    return vertices * 10 ** generator.uniform(-300, 300), faces


def _modest_scale(generator, vertices, faces):
    return vertices * 10 ** generator.uniform(-12, 12), faces


def _far_away(generator, vertices, faces):
    return vertices + generator.normal(size=3) * 10 ** generator.uniform(0, 20), faces


_ON_FILES = {"bytes": _bytes, "tokens": _tokens, "counts": _counts}
_ON_ARRAYS = {
    "flipped faces": _flip,
    "hole": _hole,
    "doubled faces": _double,
    "glued vertices": _glue,
    "fin": _fin,
    "wrong index": _index,
    "stray vertices": _strays,
    "twin": _twins,
    "seam": _seam,
    "order": _order,
    "not finite": _not_finite,
    "spike": _spike,
    "noise": _noise,
    "flat": _flat,
    "slivers": _slivers,
    "scale": _scale,
    "modest scale": _modest_scale,
    "far away": _far_away,
}
