"""A generated benchmark of labelled, closed triangle meshes, for the demo and the tests.

A class is a skeleton: a tree of solids, each with a signed distance function (negative inside) and a ball joint with
limits that connects it to its parent. The solids are blended by a smooth union, whose zero level set is meshed by
marching cubes (Lewiner, Lopes, Vieira and Tavares 2003). The mesh is relaxed along the surface and checked.

Each module imports only from those before it: solids, skeleton, templates, meshing, benchmark.
"""

from igps.shapes.benchmark import ArticulatedShapes, GeneratedShape

__all__ = ["ArticulatedShapes", "GeneratedShape"]
