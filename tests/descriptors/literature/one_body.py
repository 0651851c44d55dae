"""One body for the descriptors that look at one body at a time."""

import numpy as np

from igps.data.batch import Body
from igps.data.collation import collate
from igps.signature.signature import Samples


def of_mesh(mesh):
    """A body of which the mesh is known, and no sample and no eigenpair: a descriptor that reads them fails."""
    nothing = Samples(
        np.zeros((0, 3)),
        np.zeros((0, 0), dtype=np.float32),
    )
    return Body(
        np.zeros(0),
        nothing,
        nothing,
        mesh.area,
        mesh.volume,
        mesh.name,
        mesh,
    )


def of_signature(signature):
    """A body of which the signature is known, and not the mesh: a descriptor that reads it fails."""
    return next(collate([signature]).bodies())


def of_points(points, area=1.0, eigenvalues=None):
    """A body of which the samples of the surface, the area and the eigenvalues are known, and nothing else."""
    samples = Samples(
        points,
        np.zeros((len(points), 1), dtype=np.float32),
    )
    nothing = Samples(
        np.zeros((0, 3)),
        np.zeros((0, 1), dtype=np.float32),
    )
    return Body(
        np.ones(1) if eigenvalues is None else eigenvalues,
        nothing,
        samples,
        area,
        1.0,
        "points",
        None,
    )
