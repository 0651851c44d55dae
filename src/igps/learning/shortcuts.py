"""What tells the classes of a collection and has nothing to do with form."""

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from statistics import fmean

from igps.data.dataset import SignatureDataset

_MIN_ACCURACY = 0.9  # balanced accuracy from which on classes are told
_MIN_BODIES = 8


def shortcuts(dataset: SignatureDataset) -> list[str]:
    """Return sentences on numbers and names by which the classes can be told without looking at a body.

    These are the type of file, the file's name without digits unless the class is part of it, the unit, and columns of
    `labels.csv`, such as the scanner. Each body is given the most frequent class of the others with the same value;
    if this is right in nine of ten cases, with equal weight for all classes, a classifier may have learned the value.
    """
    bodies = dataset.bodies
    labels = bodies.labels
    if labels is None or len(labels) < _MIN_BODIES or len(set(labels)) < 2:
        return []
    values: dict[str, Sequence[str]] = {
        "the type of file": ["".join(path.suffixes) for path in bodies.paths],
        "the name of the file": [_without_digits(path.name) for path in bodies.paths],
        "the unit": [str(unit) for unit in dataset.units()],
    }
    for column, entries in bodies.columns.items():
        values[f"the column {column!r}"] = list(map(str, entries))
    found = []
    for name, own in values.items():
        accuracy = _accuracy(own, labels)
        is_class = name == "the name of the file" and _names_classes(own, labels)
        if accuracy >= _MIN_ACCURACY and not is_class:
            found.append(
                f"{name} tells the classes of {accuracy:.0%} of the bodies: scores may be of this, and not of form."
            )
    return found


def _without_digits(name: str) -> str:
    return re.sub(r"\d+", "#", name.lower())


def _names_classes(patterns: Sequence[str], labels: Sequence[str]) -> bool:
    """Return whether files are called by their classes."""
    pairs = zip(patterns, labels, strict=True)
    return all(_without_digits(label) in pattern for pattern, label in pairs)


def _accuracy(values: Sequence[str], labels: Sequence[str]) -> float:
    """Return the balanced accuracy of the most frequent class of the other bodies with the same value."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for value, label in zip(values, labels, strict=True):
        counts[value][label] += 1
    is_right: dict[str, list[bool]] = defaultdict(list)
    for value, label in zip(values, labels, strict=True):
        others = counts[value] - Counter([label])
        guess = max(others, key=others.__getitem__, default="")
        is_right[label].append(guess == label)
    return fmean(fmean(own) for own in is_right.values())
