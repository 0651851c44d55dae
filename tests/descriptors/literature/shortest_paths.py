"""Geodesic distances by the graph that the compared descriptors walk."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse.csgraph import dijkstra

from igps.descriptors.literature._geodesics import edge_graph, farthest_points
from igps.mesh.mesh import Mesh

__all__ = ["farthest_points", "geodesic_distances"]


def geodesic_distances(
    mesh: Mesh, sources: Sequence[int] | np.ndarray, points_per_edge: int = 2
) -> np.ndarray:
    """(S, V) from some vertices to all, length."""
    return dijkstra(edge_graph(mesh, points_per_edge), indices=sources)[:, : len(mesh.vertices)]
