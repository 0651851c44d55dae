"""STEP files of boxes, written line by line (ISO 10303-21, AP214)."""

from __future__ import annotations

import itertools


class _Lines:
    def __init__(self):
        self.lines: list[str] = []

    def __call__(self, text):
        self.lines.append(f"#{len(self.lines) + 1}={text};")
        return f"#{len(self.lines)}"


def write_step(path, parts, unit=".MILLI."):
    """Parts of boxes from their least to their greatest corners, each a solid.

    `unit` is a prefix of metres, ".MILLI." or "$".
    """
    add = _Lines()
    length = add(f"(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT({unit},.METRE.))")
    angle = add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
    solid_angle = add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
    blur = add(
        f"UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-7),{length},'distance_accuracy_value','')"
    )
    context = add(
        f"(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT(({blur}))"
        f"GLOBAL_UNIT_ASSIGNED_CONTEXT(({length},{angle},{solid_angle}))REPRESENTATION_CONTEXT('',''))"
    )
    application = add("APPLICATION_CONTEXT('automotive design')")
    for name, boxes in parts.items():
        product_context = add(f"PRODUCT_CONTEXT('',{application},'mechanical')")
        product = add(f"PRODUCT('{name}','{name}','',({product_context}))")
        formation = add(f"PRODUCT_DEFINITION_FORMATION('','',{product})")
        design = add(f"PRODUCT_DEFINITION_CONTEXT('part definition',{application},'design')")
        definition = add(f"PRODUCT_DEFINITION('design','',{formation},{design})")
        shape = add(f"PRODUCT_DEFINITION_SHAPE('','',{definition})")
        origin = _placement(
            add,
            (0, 0, 0),
            (0, 0, 1),
            (1, 0, 0),
        )
        solids = ",".join(_box(add, low, high) for low, high in boxes)
        form = add(f"ADVANCED_BREP_SHAPE_REPRESENTATION('',({origin},{solids}),{context})")
        add(f"SHAPE_DEFINITION_REPRESENTATION({shape},{form})")
    head = "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION((''),'2;1');\nFILE_NAME('','',(''),(''),'','','');\n"
    schema = "FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));\nENDSEC;\nDATA;\n"
    path.write_text(head + schema + "\n".join(add.lines) + "\nENDSEC;\nEND-ISO-10303-21;\n")


def _point(add, place):
    return add(f"CARTESIAN_POINT('',({','.join(f'{float(x):.6f}' for x in place)}))")


def _direction(add, way):
    return add(f"DIRECTION('',({','.join(f'{float(x):.6f}' for x in way)}))")


def _placement(add, place, axis, reference):
    parts = _point(add, place), _direction(add, axis), _direction(add, reference)
    return add(f"AXIS2_PLACEMENT_3D('',{','.join(parts)})")


def _box(add, low, high):
    corners = {}
    vertices = {}
    for bits in itertools.product((0, 1), repeat=3):
        corners[bits] = tuple(high[i] if bits[i] else low[i] for i in range(3))
        vertices[bits] = add(f"VERTEX_POINT('',{_point(add, corners[bits])})")
    edges = {}
    for bits, axis in itertools.product(corners, range(3)):
        if not bits[axis]:
            other = tuple(1 if i == axis else bit for i, bit in enumerate(bits))
            way = _direction(
                add,
                tuple(float(i == axis) for i in range(3)),
            )
            vector = add(f"VECTOR('',{way},1.)")
            line = add(f"LINE('',{_point(add, corners[bits])},{vector})")
            edges[bits, other] = add(
                f"EDGE_CURVE('',{vertices[bits]},{vertices[other]},{line},.T.)"
            )
    faces = []
    for axis, side in itertools.product(range(3), (0, 1)):
        u = (axis + 1) % 3
        v = (axis + 2) % 3
        ring = []
        for a, b in ((0, 0), (1, 0), (1, 1), (0, 1)) if side else ((0, 0), (0, 1), (1, 1), (1, 0)):
            bits = [0, 0, 0]
            bits[axis] = side
            bits[u] = a
            bits[v] = b
            ring.append(tuple(bits))
        oriented = []
        for start, end in zip(ring, ring[1:] + ring[:1], strict=True):
            forward = (start, end) in edges
            edge = edges[(start, end) if forward else (end, start)]
            oriented.append(add(f"ORIENTED_EDGE('',*,*,{edge},.{'T' if forward else 'F'}.)"))
        loop = add(f"EDGE_LOOP('',({','.join(oriented)}))")
        bound = add(f"FACE_OUTER_BOUND('',{loop},.T.)")
        outward = tuple((1.0 if side else -1.0) * (i == axis) for i in range(3))
        sideways = tuple(float(i == u) for i in range(3))
        plane = add(f"PLANE('',{_placement(add, corners[ring[0]], outward, sideways)})")
        faces.append(add(f"ADVANCED_FACE('',({bound}),{plane},.T.)"))
    shell = add(f"CLOSED_SHELL('',({','.join(faces)}))")
    return add(f"MANIFOLD_SOLID_BREP('',{shell})")
