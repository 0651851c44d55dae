"""Asymmetry of paired structures: how far the left one is from the mirrored right one, and for whom this is unusual."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
import torch
from torch import Tensor

from igps._arrays import Floats
from igps.analysis.groups import codes_of
from igps.analysis.outliers import deviations_of, max_bodies_of_subject
from igps.data.sources import Bodies, file_name_of
from igps.nn.descriptor import Descriptor

MIN_SUBJECTS = 5
"""Smallest number of subjects with a structure, for a score."""

# Words that name a side, between characters that are no letters: kidney_left, Left-Hippocampus, ctx-lh-insula, hip_L
_SIDE = re.compile(r"(?<![a-z])(left|right|lh|rh|l|r)(?![a-z])", re.IGNORECASE)


@dataclass(frozen=True)
class Pair:
    """A left and a right structure of one subject."""

    subject: str
    structure: str  # the name without its side
    left: int  # index of the body
    right: int


@dataclass(frozen=True)
class Asymmetry:
    """How far the two structures of a pair differ."""

    pair: Pair
    form: float  # distance of the left one and the mirrored right one
    size: float  # difference of the volumes, left minus right, over their mean
    # Robust standard deviations from the other subjects: by which the forms differ more than is usual, and by which the
    # sizes differ otherwise than is usual; None if they are too few, or if the border of the image may have cut one
    form_score: float | None
    size_score: float | None

    @property
    def score(self) -> float | None:
        """The larger of both scores."""
        if self.form_score is None or self.size_score is None:
            return None
        return max(self.form_score, self.size_score)


def find_pairs(bodies: Bodies) -> list[Pair]:
    """Return the pairs of bodies whose names differ by a side alone, such as `kidney_left` and `kidney_right`.

    The side may stand in the name of a body in its file, in that of the file, or in that of a folder. What remains of
    it names the structure, and the other parts of the path name the subject. If no part of a path is left, as for
    `1_left.ply` and `2_left.ply`, the structures are the subjects.
    """
    lefts: dict[tuple[str, str], int] = {}
    rights: dict[tuple[str, str], int] = {}
    for i, (name, part) in enumerate(zip(bodies.names, bodies.parts, strict=True)):
        place = _place(name, part)
        if place is not None:
            subject, structure, side = place
            own_side = lefts if side == "l" else rights
            own_side.setdefault((subject, structure), i)
    pairs = []
    for (subject, structure), left in lefts.items():
        right = rights.get((subject, structure))
        if right is not None:
            pairs.append(Pair(subject or ".", structure or "all", left, right))
    subjects = {pair.subject for pair in pairs}
    if subjects == {"."} and len(pairs) > 1 and not any(bodies.parts):
        return [Pair(pair.structure, "all", pair.left, pair.right) for pair in pairs]
    return pairs


def _place(name: str, part: str | None) -> tuple[str, str, str] | None:
    """Return the subject, the structure and the side, "l" or "r", of a body; None if its name tells no side."""
    path = PurePath(file_name_of(name, part))
    words = list(path.parts)
    if part is not None and path.name.startswith(f"{part}."):  # a mask that is named after its file
        words[-1] = part
    elif part is not None:
        words.append(part)
    for i in reversed(range(len(words))):
        found = _SIDE.search(words[i])
        if found is not None:
            before = words[i][: found.start()]
            after = words[i][found.end() :]
            structure = f"{before.rstrip('-_. ')} {after.lstrip('-_. ')}".strip()
            subject = "/".join([*words[:i], *words[i + 1 :]])
            return subject, structure.replace(" ", "_"), found[0][0].lower()
    return None


def asymmetries(
    pairs: Sequence[Pair],
    descriptor: Descriptor,
    descriptions: Tensor,
    volumes: Floats,
    is_cut: Sequence[bool] | None = None,
) -> list[Asymmetry]:
    """Return how far the structures of each pair differ, the most unusual first.

    The table is that of BrainPrint (Wachinger et al. 2015): a distance for each subject and structure. Scores are those
    of `outliers`, among all subjects of a structure.

    Args:
        pairs: pairs of N bodies, see `find_pairs`.
        descriptor: a descriptor that takes mirror images for the same, and ignores size.
        descriptions: (N, ...) of the bodies.
        volumes: (N,) of the bodies.
        is_cut: which of the N bodies the border of an image may have cut; their pairs have no scores.
    """
    forms = []
    with torch.inference_mode():
        for pair in pairs:
            one = descriptions[[pair.left]]
            other = descriptions[[pair.right]]
            forms.append(float(descriptor.distances(one, other)))
    left = volumes[[pair.left for pair in pairs]]
    right = volumes[[pair.right for pair in pairs]]
    sizes = 2 * (left - right) / (left + right)
    codes = codes_of([pair.structure for pair in pairs])
    n_per_subject = max_bodies_of_subject([pair.subject for pair in pairs], codes)
    cut = is_cut or [False] * len(volumes)
    has_cut = [cut[pair.left] or cut[pair.right] for pair in pairs]
    is_whole = ~np.array(has_cut, dtype=bool)
    n_whole = np.bincount(codes, weights=is_whole)
    is_scored = is_whole & (n_whole[codes] >= MIN_SUBJECTS)
    logarithms = np.log(np.maximum(forms, 1e-12))
    logarithms = np.where(is_scored, logarithms, np.nan)
    form_scores, _ = deviations_of(logarithms, codes, "shape", n_per_subject)
    known_sizes = np.where(is_scored, sizes, np.nan)
    size_scores, _ = deviations_of(known_sizes, codes, "volume", n_per_subject)
    found = []
    for i, pair in enumerate(pairs):
        scores: list[float | None] = [None, None]
        if is_scored[i]:
            scores = [float(form_scores[i]), float(size_scores[i])]
        found.append(Asymmetry(pair, forms[i], float(sizes[i]), *scores))

    def unusualness(one: Asymmetry) -> float:
        return -np.inf if one.score is None else one.score

    return sorted(found, key=unusualness, reverse=True)
