"""A generated benchmark of labelled, closed triangle meshes, for the demo and the tests.

A class is a skeleton: a tree of solids, each with a signed distance function (negative inside), joined to its parent by
a ball joint with limits. The solids are blended by a smooth union and the zero level set is meshed by marching cubes
(Lewiner, Lopes, Vieira and Tavares 2003), relaxed along the surface and checked.

Each module uses only those before it: solids, skeleton, templates, meshing, benchmark.
"""

from igps.shapes.benchmark import ArticulatedShapes, GeneratedShape

__all__ = ["ArticulatedShapes", "GeneratedShape"]
