"""Groups of files that are copies of one another."""

import math
from typing import Protocol

from scipy.cluster.hierarchy import DisjointSet

from igps.duplicates.calibration import Calibration

Pairs = dict[tuple[int, int], float]
"""Distances of pairs of files, by their indices."""


class Comparison(Protocol):
    """What `assigned` asks of files, see `Surfaces`."""

    def coarseness(self, i: int) -> float: ...

    def distance(self, i: int, j: int, calibration: Calibration) -> float: ...


def assigned(members: list[int], surfaces: Comparison, calibration: Calibration) -> Pairs:
    """Assign the files of a group, finest first, and return the pairs of a file and the finer one that it joins.

    Each file joins the nearest leader of a group that is the same; otherwise the nearest other file that is the same;
    otherwise it is the leader of a new group.
    """
    leaders: list[int] = []
    followers: list[int] = []
    pairs: Pairs = {}
    for i in sorted(members, key=lambda member: (surfaces.coarseness(member), member)):
        for finer in (leaders, followers):
            distances = [surfaces.distance(j, i, calibration) for j in finer]
            nearest = min(distances, default=math.inf)
            if nearest < math.inf:
                pairs[finer[distances.index(nearest)], i] = nearest
                followers.append(i)
                break
        else:
            leaders.append(i)
    return pairs


def groups_of(joined: Pairs) -> list[list[int]]:
    """Return the sorted connected components of the pairs."""
    group = DisjointSet({i for pair in joined for i in pair})
    for i, j in joined:
        group.merge(i, j)
    return sorted(sorted(members) for members in group.subsets())
