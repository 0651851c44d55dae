"""Generated classes of bodies in poses, on which the metric of the library is trained and design choices are tested.

A class has several bodies. The poses of a body bend the same surface at rest. Each module imports only modules before
it in this order:

- polygons, plates, springs, limbs, creatures, artefacts: solids and builders of skeletons
- kinds: the classes
- skinning, rods, rigging, posing: bending of bodies
- crossing, bodies, individuals: sound bodies, poses, and individuals of a body
- scans, shapes: remeshing, noise and motion of surfaces, and the benchmark
"""

from training.shapes.benchmark import (
    GradedShape,
    GradedShapes,
    body_of,
    family_of,
    individual_of,
    looks_alike,
)

__all__ = ["GradedShape", "GradedShapes", "body_of", "family_of", "individual_of", "looks_alike"]
