"""Geodesic distances by the graph that the compared descriptors walk."""

from scipy.sparse.csgraph import dijkstra

from igps.descriptors.literature.geodesics import edge_graph, farthest_points

__all__ = ["farthest_points", "geodesic_distances"]


def geodesic_distances(mesh, sources, points_per_edge=2):
    """(S, V) from some vertices to all, length."""
    return dijkstra(edge_graph(mesh, points_per_edge), indices=sources)[:, : len(mesh.vertices)]
