"""Generated benchmarks of labelled, closed triangle meshes.

A class is a skeleton: a tree of solids, each with a signed distance function (negative inside), joined to its parent by
a ball joint with limits. The first classes are named templates, every further one is drawn from a grammar of skeletons.
The solids are blended by a smooth union and the zero level set is meshed by marching cubes (Lewiner, Lopes, Vieira and
Tavares 2003), relaxed along the surface and checked.

`ArticulatedShapes` has one level: a shape is one pose of its class, in proportions of its own, meshed anew.
`GradedShapes` has two: a class has bodies, and a body has poses, which bend the one surface that it has at rest.

Each module uses only those before it: solids, skeleton, templates and limbs, creatures, artefacts and plates (the
families of the grammar), meshing, grammar, files, benchmark; and for the graded shapes kinds (their classes), skinning,
rods (how a body is bent), crossing, bodies, scans (what else happens to a surface), graded.
"""

from igps.shapes.benchmark import ArticulatedShapes, GeneratedShape
from igps.shapes.graded import GradedShape, GradedShapes, body_of, family_of, looks_alike

__all__ = ["ArticulatedShapes", "GeneratedShape", "GradedShape", "GradedShapes", "body_of", "family_of", "looks_alike"]
