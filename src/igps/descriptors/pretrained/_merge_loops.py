"""The loop of `merge_tree` that Numba compiles."""

from __future__ import annotations

import numpy as np

from igps._arrays import Integers
from igps._compiled import compiled


@compiled()
def merge(
    order: Integers, neighbours: Integers, counts: Integers, ends: Integers,
    pieces: Integers,
) -> int:  # fmt: skip
    """Write the branches and the pieces of a function on a graph, see `merge_tree`; how many branches there are.

    The points (P,) come in order, the highest first. Written are the peak and the saddle of each branch to (P, 2), and
    the peak of the piece of each point to (L, P), which holds −1.
    """
    n_points, n_neighbours = neighbours.shape
    place = np.empty(n_points, np.int64)
    for k in range(n_points):
        place[order[k]] = k
    # of each point the others that name it, one list after the other; while they are filled, point i has place i + 1
    starts = np.zeros(n_points + 2, np.int64)
    for i in range(n_points):
        for j in range(n_neighbours):
            starts[neighbours[i, j] + 2] += 1
    parent = np.empty(n_points, np.int64)
    for i in range(n_points):
        starts[i + 1] += starts[i]
        parent[i] = i
    naming = np.empty(n_points * n_neighbours, np.int64)
    for i in range(n_points):
        for j in range(n_neighbours):
            named = neighbours[i, j]
            naming[starts[named + 1]] = i
            starts[named + 1] += 1
    n_branches = level = 0
    for reached in range(n_points):
        point = order[reached]
        for j in range(n_neighbours + starts[point + 1] - starts[point]):
            other = neighbours[point, j] if j < n_neighbours else naming[starts[point] + j - n_neighbours]
            if place[other] >= reached:
                continue
            first, second = point, other
            while parent[first] != first:
                parent[first] = parent[parent[first]]
                first = parent[first]
            while parent[second] != second:
                parent[second] = parent[parent[second]]
                second = parent[second]
            if first == second:
                continue
            if place[first] < place[second]:
                first, second = second, first
            parent[first] = second  # the higher peak lives on
            if first != point:
                ends[n_branches, 0], ends[n_branches, 1] = first, point
                n_branches += 1
        while level < len(counts) and counts[level] == reached + 1:
            for k in range(reached + 1):
                root = order[k]
                while parent[root] != root:
                    root = parent[root]
                pieces[level, order[k]] = root
            level += 1
    for k in range(n_points):
        point = order[k]
        if parent[point] == point:
            ends[n_branches, 0], ends[n_branches, 1] = point, order[n_points - 1]
            n_branches += 1
    return n_branches
