"""Histograms by their definition, one pair of points at a time, and mean values, one point at a time."""

import math
from functools import reduce
from itertools import combinations_with_replacement

import numpy as np
from numpy.linalg import det, norm


def hat(value, centres):
    """The linear kernel of one value, one centre at a time."""
    shares = [0.0] * len(centres)
    if value <= centres[0]:
        shares[0] = 1.0
    elif value >= centres[-1]:
        shares[-1] = 1.0
    else:
        upper = next(k for k, centre in enumerate(centres) if centre > value)
        shares[upper] = (value - centres[upper - 1]) / (centres[upper] - centres[upper - 1])
        shares[upper - 1] = 1 - shares[upper]
    return shares


def equal_bins(n, reach):
    """Middles of n equal intervals of [0, reach]."""
    return [(k + 0.5) * reach / n for k in range(n)]


def hard_classes(values, edges):
    """(P, C) one-hot rows: how many of the edges between classes a value has reached."""
    numbers = [sum(float(value) >= edge for edge in edges) for value in values]
    return np.eye(len(edges) + 1)[numbers]


def soft_classes(values, centres):
    """(P, C) hats."""
    return np.array([hat(float(value), centres) for value in values])


def product(*classes):
    """(P, C₁·C₂…) combinations, the first changing slowest."""
    return np.array([reduce(np.kron, rows) for rows in zip(*classes, strict=True)])


def distances(points):
    """(P, P)."""
    rows = points.tolist()
    return np.array([[math.dist(p, q) for q in rows] for p in rows])


def twists(points, directions):
    """The signed twist of each pair of oriented points, (P, P)."""
    p = points.double().numpy()
    n = directions.double().numpy()
    found = np.zeros((len(p), len(p)))
    for i in range(len(p)):
        for j in range(len(p)):
            if i != j:
                found[i, j] = np.linalg.det([n[i], n[j], p[j] - p[i]]) / np.linalg.norm(p[j] - p[i])
    return found


def cosines(points, directions):
    """The three cosines of each pair of oriented points (Wahl et al. 2003), each (P, P)."""
    p = points.double().numpy()
    n = directions.double().numpy()
    features = np.zeros((3, len(p), len(p)))
    for i in range(len(p)):
        for j in range(len(p)):
            if i != j:
                line = (p[j] - p[i]) / math.dist(p[i], p[j])
                ends = (float(n[i] @ line), -float(n[j] @ line))
                features[:, i, j] = max(ends), min(ends), n[i] @ n[j]
    return list(features)


def pair_histogram_by_loops(memberships, axes):
    """(C(C+1)/2, B, ...) of memberships (P, C) and, for each dimension, values (P, P) of the pairs and centres (B,)."""
    m = np.asarray(memberships, dtype=float)
    rows = list(combinations_with_replacement(range(m.shape[1]), 2))
    histogram = np.zeros((len(rows), *(len(centres) for _, centres in axes)))
    n_pairs = 0
    for i in range(len(m)):
        for j in range(i):
            shares = [np.array(hat(values[i, j], centres)) for values, centres in axes]
            share = reduce(np.multiply.outer, shares)
            for row, (a, b) in enumerate(rows):
                weight = m[i, a] * m[j, b] + (m[i, b] * m[j, a] if a != b else 0)
                if weight:
                    histogram[row] += weight * share
            n_pairs += 1
    return histogram / n_pairs


def mean_values(vertices, faces, points, functions):
    """(P, K) mean value interpolation of functions (V, K), point by point (Ju, Schaefer and Warren 2005)."""
    values = np.empty((len(points), functions.shape[1]))
    for i, point in enumerate(points):
        offset = vertices - point
        distance = norm(offset, axis=1)
        u = (offset / distance[:, None])[faces]
        sides = norm(
            np.roll(u, -1, axis=1) - np.roll(u, -2, axis=1),
            axis=2,
        )
        angles = 2 * np.arcsin(np.clip(sides / 2, 0, 1))
        half = angles.sum(axis=1, keepdims=True) / 2
        sines = np.sin(angles)
        sine_after = np.roll(sines, -1, axis=1)
        sine_before = np.roll(sines, -2, axis=1)
        cosines = 2 * np.sin(half) * np.sin(half - angles) / (sine_after * sine_before) - 1
        signed_sines = np.sign(det(u))[:, None] * np.sqrt(np.clip(1 - cosines**2, 0, None))
        numerators = (
            angles
            - np.roll(cosines, -1, axis=1) * np.roll(angles, -2, axis=1)
            - np.roll(cosines, -2, axis=1) * np.roll(angles, -1, axis=1)
        )
        weights = numerators / (distance[faces] * sine_after * np.roll(signed_sines, -2, axis=1))
        # A face does not count for points in its plane outside the face.
        weights[(np.abs(signed_sines) < 1e-7).any(axis=1)] = 0
        total = np.bincount(faces.ravel(), weights.ravel(), len(vertices))
        values[i] = total @ functions / total.sum()
    return values
