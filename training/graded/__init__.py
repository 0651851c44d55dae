"""Generated classes of bodies in poses, on which the library's metric is trained and its choices are made.

A class has bodies, and a body has poses, which bend the one surface that it has at rest. Each module uses only those
before it: polygons, plates, limbs, creatures, artefacts, kinds (the classes), skinning, rods (how a body is
bent), crossing, bodies, individuals, scans (what else happens to a surface), shapes.
"""

from training.graded.shapes import GradedShape, GradedShapes, body_of, family_of, individual_of, looks_alike

__all__ = ["GradedShape", "GradedShapes", "body_of", "family_of", "individual_of", "looks_alike"]
