"""The options by which commands read meshes, and the signatures and descriptions that result."""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import reduce
from itertools import chain
from operator import or_
from pathlib import Path
from typing import Any

from torch import Tensor

from igps._arrays import Floats, Singles
from igps._text import counted
from igps.cli.shared_options import ClassRule, Mirror, Size, limits_of
from igps.data.attribute_sources import attribute_sources
from igps.data.cache import default_cache_dir
from igps.data.dataset import Failure, SignatureDataset
from igps.data.requirements import Requirements
from igps.data.sources import Bodies, file_and_part, file_name_of, find_bodies
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.fingerprint import cache_tag, name_of
from igps.descriptors.measures import Measures
from igps.descriptors.size_and_side import SIDE, SIZE, keeps_size, scale_of
from igps.fields.volumes.border import border_of
from igps.mesh.mending import repair_steps
from igps.mesh.mesh import MILLIMETRES
from igps.mesh.options import LoadOptions
from igps.nn.description import check_attributes, describe, fit_centres
from igps.nn.descriptor import Descriptor
from igps.report.tables import write_rows
from igps.signature.signature import SignatureConfig

_N_REASONS = 20  # of bodies that could not be used; more would hide the results above them
_RESIDUES = re.compile(r"(\d+) (residues .*)")


@dataclass(frozen=True)
class Folder:
    """Source of bodies: a folder, searched according to the options."""

    root: Path
    labelled: bool = False  # whether classes are required
    # Called before any computation; raises for unsuitable bodies
    check: Callable[[Bodies], object] | None = None
    body: str | None = None  # only bodies of this name in their files, such as an organ


@dataclass(frozen=True, eq=False)
class Described:
    """Bodies and their descriptions."""

    dataset: SignatureDataset  # the N bodies that could be used
    descriptions: Tensor  # (N, ...)
    failures: list[Failure]  # the other bodies
    descriptor: Descriptor
    # Name that loads the descriptor; None where its centres were fitted to the collection
    name: str | None

    def vectors(self, short: bool = False) -> Singles:
        """Return the descriptions (N, ...), or their short vectors, see `Descriptor.shorten`."""
        rows = self.descriptor.shorten(self.descriptions) if short else self.descriptions
        return rows.numpy()

    def coordinates(self, *, within_class: bool = False) -> Floats:
        """Return vectors (N, D) for statistics, see `Descriptor.coordinates`."""
        return (
            self.descriptor.coordinates(self.descriptions, within_class=within_class)
            .double()
            .numpy()
        )


def signatures(
    source: Folder | Sequence[Path] | Bodies,
    descriptors: Sequence[Descriptor] = (),
    strict: bool = False,
    n_workers: int | None = None,
    time_limit: float | None = None,
    memory_limit: float | None = None,
    complete: bool = False,
    also: Requirements | None = None,
    **collection: Any,
) -> tuple[SignatureDataset, list[Failure]]:
    """Compute the signatures that are missing in the cache.

    Args:
        source: bodies.
        descriptors: descriptors whose requirements the signatures must meet.
        also: further requirements.
        strict, n_workers, time_limit, memory_limit, complete, collection: options of every command that reads bodies,
            see `igps.cli.shared_options.GROUPS`.

    Returns:
        The bodies whose signatures are in the cache, and the failures of the others.

    Raises:
        ValueError: no body could be used.
    """
    all_requirements = [d.requirements for d in descriptors]
    if also is not None:
        all_requirements.append(also)
    requirements = reduce(or_, all_requirements) if all_requirements else None
    dataset = dataset_from_options(source, requirements, **collection)
    for descriptor in descriptors:
        check_attributes(descriptor, {*dataset.config.attributes, *dataset.pipeline.attributes})
    failures = dataset.precompute(
        n_workers=n_workers, strict=strict, limits=limits_of(time_limit, memory_limit)
    )
    if len(failures) == len(dataset):
        raise ValueError(
            f"none of {counted(len(dataset), 'body')} could be used; the first: {failures[0].error}"
        )
    usable = dataset.usable(failures)
    if complete:
        usable = _complete(usable)
    if summary := mending_summary(usable, len(dataset)):
        print(summary)
    for line in residue_summaries(usable):
        print(line)
    for descriptor in descriptors:
        print_reading_warning(descriptor, usable)
    return usable, failures


def described(
    source: Folder | Sequence[Path] | Bodies,
    descriptor: str | Descriptor,
    strict: bool = False,
    n_workers: int | None = None,
    size: Size = "auto",
    mirror: Mirror = "auto",
    **reading: Any,
) -> Described:
    """Describe bodies, after computing the signatures that are missing in the cache; see `signatures`.

    Prints how many bodies could not be used. The options `size` and `mirror` extend the name of a descriptor; they do
    not change a `Descriptor`.
    """
    if isinstance(descriptor, str):
        descriptor = with_side(descriptor, mirror, size)
    dataset, failures = signatures(
        source, [descriptor_of(descriptor)], strict=strict, n_workers=n_workers, **reading
    )
    if isinstance(descriptor, str):
        descriptor = with_size(descriptor, size, dataset)
    module = descriptor_of(descriptor)
    name = None if fit_centres(module, dataset) else name_of(descriptor)
    undescribed: list[Failure] | None = None if strict else []
    descriptions = describe(
        dataset,
        module,
        failures=undescribed,
        cache_tag=cache_tag(module),
        n_workers=n_workers,
        progress=True,
    )
    usable = dataset.usable(undescribed or ())
    all_failures = [*failures, *(undescribed or ())]
    print_failures(all_failures, len(usable))
    return Described(usable, descriptions, all_failures, module, name)


def _complete(dataset: SignatureDataset) -> SignatureDataset:
    """Return the bodies that do not reach the border of their image, and print how many do."""
    kept = [i for i, notes in enumerate(dataset.all_notes()) if border_of(notes) is None]
    n_cut = len(dataset) - len(kept)
    if not kept:
        raise ValueError(
            f"complete: all of {counted(n_cut, 'body')} reach the border of their image. "
            "Leave it out if the images were cropped to the bodies."
        )
    print(f"{n_cut} of {counted(len(dataset), 'body')} at the border of the image, left out")
    return dataset.subset(kept)


def files_or_folder(meshes: Sequence[Path]) -> Folder | Sequence[Path]:
    """Return a `Folder` if the only path is a folder, otherwise the paths."""
    return Folder(meshes[0]) if len(meshes) == 1 and meshes[0].is_dir() else meshes


def check_files(paths: Sequence[Path]) -> None:
    """Raise a FileNotFoundError for the first path that is no file, before anything is computed."""
    for path in paths:
        if not file_and_part(path)[0].is_file():
            reason = (
                "expected a file, got a folder" if path.is_dir() else "no such file. Check the path"
            )
            raise FileNotFoundError(f"{path}: {reason}.")


def is_named_after_file(name: str, part: str | None) -> bool:
    """Return whether the part of a body is named after its file, as in a mask without label names."""
    return Path(file_name_of(name, part)).name.startswith(f"{part}.")


def print_failures(failures: Sequence[Failure], n_used: int) -> None:
    """Print how many bodies could not be used, and why, a line for each; print nothing if there are none.

    Empty masks do not count: they are no fault, and a warning has told of them.
    """
    faults = [failure for failure in failures if not failure.summary]
    if not faults:
        return
    n_all = counted(n_used + len(failures), "body")
    print(f"{len(faults)} of {n_all} could not be used.")
    for failure in faults[:_N_REASONS]:
        print(f"  {failure.error}")
    if len(faults) > _N_REASONS:
        print(f"  … and {len(faults) - _N_REASONS} more")


def with_side(descriptor: str, mirror: Mirror, size: Size) -> str:
    """Return the name, with +side if `mirror` is "distinct"; raise a ValueError if an option contradicts the name."""
    name = descriptor_of(descriptor).name
    for option, value, excluded, suffix in (
        ("size", size, "ignore", SIZE),
        ("mirror", mirror, "same", SIDE),
    ):
        if value == excluded and suffix in name:
            raise ValueError(
                f"{option}: expected no {value!r} with {name}, which has {suffix}. Leave one of them out."
            )
    if mirror != "distinct" or SIDE in descriptor:
        return descriptor
    return descriptor.replace(SIZE, "") + SIDE + SIZE * (SIZE in descriptor)


def with_size(descriptor: str, size: Size, dataset: SignatureDataset) -> str:
    """Return the name, with +size if size counts; print a warning if the option and the units do not decide this."""
    module = descriptor_of(descriptor)
    if SIZE in module.name or "scale" not in module.invariant_to:
        if size != "auto" and SIZE not in module.name:
            print(
                f"--size {size} has no effect: {descriptor} does not declare that it ignores size (invariant_to)"
            )
        return descriptor
    is_kept, warning = keeps_size(size, () if size == "ignore" else dataset.units())
    can_keep = isinstance(module, Measures) or scale_of(module) is not None
    if is_kept and size == "auto" and not can_keep:
        is_kept = False
        warning = f"size is ignored: set the attribute `scale` of {descriptor} to keep it"
    if warning:
        print(warning)
    return descriptor + SIZE * is_kept


def print_unit_warning(descriptor: Descriptor, dataset: SignatureDataset) -> None:
    """Print how many bodies have no unit and are read as millimetres, if the descriptor keeps size."""
    n_unknown = (
        sum(unit not in MILLIMETRES for unit in dataset.units()) if SIZE in descriptor.name else 0
    )
    if n_unknown:
        reason = f"{n_unknown} of {len(dataset)} bodies have no unit"
        print(f"size is kept: {reason}; their coordinates are taken as millimetres")


def print_reading_warning(descriptor: Descriptor, dataset: SignatureDataset) -> None:
    """Print a warning if a fitted model was fitted to bodies that were read with other options."""
    fitted = descriptor.card.get("reading")
    if not isinstance(fitted, Mapping):  # not a fitted model, or its card is of an earlier version
        return
    defaults = asdict(LoadOptions())
    then = {**defaults, **fitted}
    now = {**defaults, **dataset.reading.as_dict()}
    changed = []
    for name in ("mend", "allow_open", "cavities"):
        if then[name] != now[name]:
            changed.append(f"--{name} {then[name]}, not {now[name]}")
    if changed:
        print(
            f"{descriptor.name} was fitted to bodies read with {', '.join(changed)}: its results may be wrong"
        )


def dataset_from_options(
    source: Folder | Sequence[Path] | Bodies,
    requirements: Requirements | None,
    cache_dir: Path | None = None,
    signature: SignatureConfig = SignatureConfig(),  # noqa: B008 (frozen)
    paper: bool = False,
    classes: ClassRule | None = None,
    attribute: list[str] | None = None,
    **load: Any,
) -> SignatureDataset:
    """Return the dataset that the options select, without computing anything.

    Args:
        signature: parameters of the signatures.
        classes: class of a body: its folder or an entry in labels.csv ("folder", the default), its name in its file
            ("body"), or its file ("file").

    Raises:
        ValueError: options that contradict each other or the source, or no classes where they are required.
    """
    if paper and signature != SignatureConfig():
        raise ValueError(
            "paper: expected no other parameters of the signatures with it. Leave one of them out."
        )
    config = SignatureConfig.paper() if paper else signature
    reading = LoadOptions(**load)
    attributes = attribute_sources(
        attribute or (), source.root if isinstance(source, Folder) else None
    )
    if isinstance(source, Folder):
        bodies = find_bodies(
            source.root,
            reading,
            labelled=source.labelled,
            classes=classes or "folder",
            attributes=attributes.values(),
            cache_dir=cache_dir or default_cache_dir(),
        )
        if source.body is not None:
            bodies = _named(bodies, source.body)
        if source.check is not None:
            source.check(bodies)
        source = bodies
    return SignatureDataset(
        source,
        config,
        cache_dir,
        descriptor=requirements,
        classes=classes,
        reading=reading,
        attributes=attributes,
    )


def _named(bodies: Bodies, name: str) -> Bodies:
    """Return the bodies of a name in their files."""
    chosen = [i for i, part in enumerate(bodies.parts) if part == name]
    if not chosen:
        known = ", ".join(sorted({part for part in bodies.parts if part is not None})[:10])
        raise ValueError(f"body: no file has a body {name!r}; there are: {known or 'none'}.")
    return bodies.subset(chosen)


def mending_summary(dataset: SignatureDataset, n_total: int) -> str:
    """Return a line on how many bodies were repaired and by which steps; empty if none was."""
    steps = [repair_steps(notes) for notes in dataset.all_notes()]
    counts = Counter(step for steps_of_mesh in steps for step in steps_of_mesh)
    if not counts:
        return ""
    words = {"watertight": "made watertight"}
    listed = ", ".join(f"{count} {words.get(step, step)}" for step, count in counts.most_common())
    return f"{sum(map(bool, steps))} of {counted(n_total, 'body')} repaired: {listed}"


def residue_summaries(dataset: SignatureDataset) -> list[str]:
    """Return a line for each kind of note on residues of molecules, such as those that were completed."""
    counts: dict[str, list[int]] = {}
    for note in chain.from_iterable(dataset.all_notes()):
        match = _RESIDUES.fullmatch(note)
        if match is not None:
            counts.setdefault(match[2], []).append(int(match[1]))
    bodies = counted(len(dataset), "body")
    return [f"{sum(n):,} {text} (in {len(n)} of {bodies})" for text, n in counts.items()]


def write_mending_notes(path: Path, dataset: SignatureDataset) -> None:
    """Write the notes on how each mesh was repaired, as a table."""
    meshes = zip(dataset.bodies.names, dataset.all_notes(), strict=True)
    write_rows(path, ("name", "note"), [(name, note) for name, notes in meshes for note in notes])
