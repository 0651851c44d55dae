"""Where inside the bodies of a collection attributes lie: cached rows, and remarks on what they cannot tell."""

import contextlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from igps._arrays import Booleans, Floats
from igps._parallel import on_threads
from igps.analysis.inside import (
    MIN_SAMPLES,
    REQUIREMENTS,
    VERSION,
    column_names,
    has_unit,
    inside_numbers,
)
from igps.data.attribute_sources import FileAttribute
from igps.data.cache import Record
from igps.data.dataset import Failure, SignatureDataset
from igps.data.keys import derived_key
from igps.mesh.errors import MeshError
from igps.signature.config import SignatureConfig

# Bodies of one kind hardly differ this much in the spread of one quantity, but units do: metres and millimetres, or
# shares and Hounsfield units
_MAX_RATIO = 30.0
_ROUNDING = 1e-9  # relative; numbers that vary less do not vary


def inside_config(config: SignatureConfig) -> SignatureConfig:
    """Return a configuration with what the numbers need."""
    n_samples = max(config.min_samples, MIN_SAMPLES)
    return REQUIREMENTS.apply_to(replace(config, min_samples=n_samples))


@dataclass(frozen=True, eq=False)
class InsideTable:
    """Numbers that tell where inside N bodies attributes lie."""

    attributes: tuple[str, ...]
    columns: tuple[str, ...]  # names of the numbers, see `column_names`
    rows: Floats  # (N, columns), NaN where a number is not defined

    def column(self, name: str) -> Floats:
        """Return the numbers (N,) of a column."""
        return self.rows[:, self.columns.index(name)]

    def subset(self, indices: Sequence[int]) -> "InsideTable":
        """Return the rows of some of the bodies."""
        return replace(self, rows=self.rows[list(indices)])

    def known(self, name: str) -> tuple[Booleans, Floats]:
        """Return which bodies have a number (N,), and the numbers (those bodies, 1)."""
        numbers = self.column(name)
        is_known = np.isfinite(numbers)
        return is_known, numbers[is_known, None]

    def scores(self) -> tuple[Booleans, Floats]:
        """Return which bodies have all numbers without a unit (N,), and these numbers as standard scores.

        Numbers that do not vary between bodies are left out.
        """
        chosen = [i for i, name in enumerate(self.columns) if not has_unit(name)]
        numbers = self.rows[:, chosen]
        is_whole = np.asarray(np.isfinite(numbers).all(axis=1))
        return is_whole, standard_scores(numbers[is_whole])


def standard_scores(numbers: Floats) -> Floats:
    """Return the columns of numbers (N, D) that vary, with mean 0 and standard deviation 1."""
    if not len(numbers):
        return numbers
    spread = numbers.std(axis=0)
    size = np.abs(numbers).max(axis=0)
    varies = spread > _ROUNDING * size
    chosen = numbers[:, varies]
    return (chosen - chosen.mean(axis=0)) / spread[varies]


def inside_table(
    dataset: SignatureDataset,
    attributes: Sequence[str],
    *,
    failures: list[Failure] | None = None,
    n_workers: int | None = None,
) -> InsideTable:
    """Return where inside the bodies of a dataset its attributes lie, from the cache where they are known.

    Args:
        dataset: N bodies with `inside_config` and the attributes.
        attributes: their names.
        failures: a list that receives the bodies without numbers; their rows are NaN. If None, the first raises.
        n_workers: number of threads.

    Raises:
        MeshError: a body has no numbers, and `failures` is None.
    """
    names = column_names(attributes)
    keys = dataset.cached_keys()
    cache = dataset.pipeline.cache("description")

    def row(i: int) -> Floats | str:
        whole_key = keys[i]
        key = None
        if whole_key is not None:
            key = derived_key("inside", whole_key, VERSION, list(attributes))
        known = None if key is None else cache.get(key, lambda record: record.arrays["numbers"])
        if known is not None:
            return known
        try:
            numbers = inside_numbers(dataset[i].signature, attributes)
        except ValueError as error:
            return str(error)
        found = np.array([numbers[name] for name in names])
        if key is not None:
            with contextlib.suppress(OSError):  # a cache that is not writable only costs time
                cache.put(key, Record({"numbers": found}))
        return found

    rows = []
    for i, found in enumerate(on_threads(row, range(len(dataset)), n_workers)):
        if isinstance(found, str):
            if failures is None:
                raise MeshError(found)
            failures.append(Failure.of(dataset.bodies, i, found))
            found = np.full(len(names), np.nan)
        rows.append(found)
    return InsideTable(tuple(attributes), tuple(names), np.array(rows))


def remarks(dataset: SignatureDataset, table: InsideTable) -> Iterator[str]:
    """Yield a sentence for each thing that makes numbers of an attribute undefined, or not comparable."""
    names = dataset.bodies.names
    for attribute in table.attributes:
        mean = table.column(f"{attribute}.mean")
        spread = table.column(f"{attribute}.sd")
        is_constant = np.isfinite(mean) & np.isnan(table.column(f"{attribute}.moran"))
        if is_constant.any():
            first = names[int(np.argmax(is_constant))]
            yield (
                f"{attribute} is constant in {is_constant.sum()} of {len(names)} bodies, such as {first}: "
                "numbers that compare its values are left out."
            )
        varying = np.flatnonzero(np.isfinite(spread) & ~is_constant)
        if not len(varying):
            continue
        middle = np.median(spread[varying])
        ratio = np.maximum(spread[varying] / middle, middle / spread[varying])
        worst = varying[int(np.argmax(ratio))]
        if ratio.max() > _MAX_RATIO:
            yield (
                f"{attribute} varies by {spread[worst]:.3g} in {names[worst]}, but by {middle:.3g} in most bodies: "
                "its unit seems to differ. Give all in one unit; until then use no mean, sd or quantile."
            )
        yield from _shared_files(dataset, attribute)


def _shared_files(dataset: SignatureDataset, attribute: str) -> Iterator[str]:
    """Yield a sentence if one image serves bodies of several files, and is thus not of every subject."""
    source = dataset.pipeline.attributes.get(attribute)
    if not isinstance(source, FileAttribute):
        return
    bodies_of: dict[str, set[Path]] = defaultdict(set)
    for body in dataset.bodies:
        bodies_of[source.cache_tag(body)].add(body.path)
    for files in bodies_of.values():
        if len(files) > 1:
            first, second = sorted(files)[:2]
            yield (
                f"{attribute} of {first.name} and of {second.name} is the same image: one of both is of another "
                "subject, unless the files show the same one. Check the pattern."
            )
            return
