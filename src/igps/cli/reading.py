"""How commands read meshes: the options they share, and the signatures these give."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from igps._arrays import Floats
from igps._parallel import Limits
from igps._parameters import check_positive
from igps.data.attribute_sources import attribute_sources
from igps.data.collection import is_collection
from igps.data.dataset import Failure, SignatureDataset
from igps.data.requirements import Requirements
from igps.data.sources import Bodies, ClassRule, file_and_part, file_name_of, find_bodies
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.fingerprint import cache_tag, name_of
from igps.descriptors.individual import SIDE, SIZE, Mirror, Size, keeps_size, scale_of
from igps.mesh.formats import is_searched
from igps.mesh.mending import repair_steps
from igps.mesh.mesh import MILLIMETRES
from igps.mesh.options import LoadOptions
from igps.nn.description import check_attributes, describe, fit_centres
from igps.nn.descriptor import Descriptor
from igps.report.tables import write_rows
from igps.signature.signature import SignatureConfig

MirrorOption = Literal["auto", Mirror]

FLAGS = {
    "paper": "use the parameters of Rustamov 2010: as the defaults, but the grid is never refined",
    "allow_open": "accept surfaces with holes",
    "strict": "stop at the first mesh that cannot be used instead of skipping it",
}
"""Switches of every command that passes its `**reading` on to `signatures`, and what they do."""

LISTS = {
    "attribute": "values inside the bodies, such as ct=images/{stem}.nii.gz: an image, a grid, values at vertices or "
    "in tetrahedra, below the folder; {stem}, {file} and {part} stand for the body's",
    "with": "attributes that join the descriptor, such as ct, or ct=0.5 with half the weight of shape",
}
"""Options of several words, of the same commands."""

MEANINGS = {
    **FLAGS,
    "root": "folder of meshes, with or without classes",
    "descriptor": "a name (a wrong one lists all), or package.module:NAME of one of your own",
    "gallery": "the gallery",
    "size": "keep lets differences in size count, ignore does not; auto keeps it where all files have a unit of length",
    "mirror": "distinct tells a body from its mirror image, same does not; auto is as the descriptor's name says",
    "n_workers": "processes that compute; all cores if not given",
    "time_limit": "seconds that one body may take; no limit if not given",
    "memory_limit": "gigabytes of memory that one body may take; no limit if not given",
    "cache_dir": "folder where computed signatures are kept; the user's cache directory if not given",
}
"""The help of options that the docstring of a command leaves out."""


@dataclass(frozen=True)
class Folder:
    """A folder whose bodies are found as the options say, or a file that `igps cache export` wrote of one."""

    root: Path
    labelled: bool = False  # whether it must tell classes
    needs_meshes: bool = False  # whether signatures alone are not enough
    check: Callable[[Bodies], object] | None = None  # raises what is wrong with its bodies before any is computed


@dataclass(frozen=True)
class Verdict:
    """The result of a command, and whether its exit status is 0."""

    result: Any
    is_good: bool


@dataclass(frozen=True, eq=False)
class Described:
    """Bodies and their descriptions."""

    dataset: SignatureDataset  # the N bodies that could be used
    descriptions: Tensor  # (N, ...)
    failures: list[Failure]  # the other bodies
    descriptor: Descriptor  # that described them
    name: str | None  # by which it can be loaded again; None where its centres were fitted to the collection

    def coordinates(self, *, of_one_kind: bool = False) -> Floats:
        """(N, D) for statistics, see `Descriptor.coordinates`."""
        found: Floats = self.descriptor.coordinates(self.descriptions, of_one_kind=of_one_kind).double().numpy()
        return found


def signatures(
    source: Folder | Sequence[Path] | Bodies,
    descriptors: Sequence[Descriptor] = (),
    strict: bool = False,
    n_workers: int | None = None,
    time_limit: float | None = None,
    memory_limit: float | None = None,
    **reading: Any,
) -> tuple[SignatureDataset, list[Failure]]:
    """The bodies whose signatures are in the cache, after computing what was missing; and those that failed.

    They satisfy the descriptors' requirements; a ValueError where no body could be used. The other parameters, and
    those of `chosen_dataset`, are options of every command that reads bodies, see `MEANINGS`.
    """
    needs = reduce(or_, (one.requirements for one in descriptors), Requirements()) if descriptors else None
    dataset = chosen_dataset(source, needs, **reading)
    for one in descriptors if not isinstance(source, Folder) or source.root.is_dir() else ():  # a file is checked
        check_attributes(one, {*dataset.config.attributes, *dataset.pipeline.attributes})
    failures = dataset.precompute(n_workers=n_workers, strict=strict, limits=limits_of(time_limit, memory_limit))
    if len(failures) == len(dataset):
        raise ValueError(f"none of {len(dataset)} meshes could be used; the first: {failures[0].error}")
    usable = dataset.usable(failures)
    if summary := mending_summary(usable, len(dataset)):
        print(summary)
    for one in descriptors:
        tell_reading(one, usable)
    return usable, failures


def described(
    source: Folder | Sequence[Path] | Bodies,
    descriptor: str | Descriptor,
    strict: bool = False,
    n_workers: int | None = None,
    size: Size = "auto",
    mirror: MirrorOption = "auto",
    **reading: Any,
) -> Described:
    """The bodies whose signatures are in the cache, and their descriptions; see `signatures`.

    Size and mirror are added to a descriptor's name; a descriptor itself stays as it is.
    """
    if isinstance(descriptor, str):
        descriptor = with_side(descriptor, mirror, size)
    dataset, failures = signatures(source, [descriptor_of(descriptor)], strict, n_workers, **reading)
    if isinstance(descriptor, str):
        descriptor = sized(descriptor, size, dataset)
    module = descriptor_of(descriptor)
    name = None if fit_centres(module, dataset) else name_of(descriptor)
    undescribed: list[Failure] | None = None if strict else []
    found = describe(
        dataset, module, failures=undescribed, cache_tag=cache_tag(module), n_workers=n_workers, progress=True
    )
    return Described(dataset.usable(undescribed or ()), found, [*failures, *(undescribed or ())], module, name)


def files_or_folder(meshes: Sequence[Path]) -> Folder | Sequence[Path]:
    """What a list of words names: files, or one folder or file of signatures."""
    is_one = len(meshes) == 1 and (meshes[0].is_dir() or is_collection(meshes[0]))
    return Folder(meshes[0]) if is_one else meshes


def check_files(paths: Sequence[Path]) -> None:
    """Raise a FileNotFoundError of the first that is no file, where nothing is to be computed without it."""
    for path in paths:
        if not file_and_part(path)[0].is_file():
            told = "a folder; a file expected" if path.is_dir() else "no such file. Check the path"
            raise FileNotFoundError(f"{path}: {told}.")


def is_called_by_file(name: str, part: str | None) -> bool:
    """Whether a body of this name has that of its file, as a mask without names has."""
    return Path(file_name_of(name, part)).name.startswith(f"{part}.")


def limits_of(seconds: float | None, gigabytes: float | None) -> Limits:
    """Of one body; a ValueError that names the option of a number that is none."""
    given = {"time_limit": seconds, "memory_limit": gigabytes}
    check_positive(**{name: value for name, value in given.items() if value is not None})
    return Limits(seconds, None if gigabytes is None else int(gigabytes * 1e9))


def print_failures(failures: Sequence[Failure], n_used: int) -> None:
    """How many bodies could not be used, if there are any."""
    if failures:
        n_given = n_used + len(failures)
        print(f"{len(failures)} of {n_given} meshes could not be used. The first: {failures[0].error}")


def with_side(descriptor: str, mirror: MirrorOption, size: Size) -> str:
    """The name with +side where mirror images are to be told apart; a ValueError where it contradicts the options."""
    for option, value, refused, mark in (("size", size, "ignore", SIZE), ("mirror", mirror, "same", SIDE)):
        if value == refused and mark in (name := descriptor_of(descriptor).name):
            raise ValueError(f"{option}: expected no {value!r} beside {name}, which is {mark}. Leave one of them out.")
    if mirror != "distinct" or SIDE in descriptor:
        return descriptor
    return descriptor.replace(SIZE, "") + SIDE + SIZE * (SIZE in descriptor)


def sized(descriptor: str, size: Size, dataset: SignatureDataset) -> str:
    """The name with or without +size, as the option and the units of the bodies say; prints what they leave open."""
    module = descriptor_of(descriptor)
    if SIZE in module.name or "scale" not in module.invariant_to:
        if size != "auto" and SIZE not in module.name:
            print(f"size is left to {descriptor}, which does not say of itself that it ignores size (invariant_to)")
        return descriptor
    is_kept, told = keeps_size(size, () if size == "ignore" else dataset.units())
    if is_kept and size == "auto" and scale_of(module) is None:
        is_kept, told = False, f"size is ignored: set the attribute `scale` of {descriptor} to keep it"
    if told:
        print(told)
    return descriptor + SIZE * is_kept


def tell_units(descriptor: Descriptor, dataset: SignatureDataset) -> None:
    """Say how many bodies count as in millimetres because their files tell no unit, where size is kept."""
    n_unknown = sum(unit not in MILLIMETRES for unit in dataset.units()) if SIZE in descriptor.name else 0
    if n_unknown:
        print(f"size is kept: {n_unknown} of {len(dataset)} bodies have no unit; their numbers count as millimetres")


def tell_reading(descriptor: Descriptor, dataset: SignatureDataset) -> None:
    """Say how the bodies that a model was fitted to were read, where these are read otherwise."""
    fitted = descriptor.card.get("reading")
    if not isinstance(fitted, Mapping):  # it was not fitted, or before cards told
        return
    then, now = ({**asdict(LoadOptions()), **options} for options in (fitted, dataset.reading.as_dict()))
    names = ("mend", "component", "allow_open", "cavities")
    if others := [f"--{name} {then[name]}, not {now[name]}" for name in names if then[name] != now[name]]:
        print(f"{descriptor.name} was fitted to bodies read with {', '.join(others)}: its answers may be wrong")


def chosen_dataset(
    source: Folder | Sequence[Path] | Bodies,
    needs: Requirements | None,
    cache_dir: Path | None = None,
    signature: SignatureConfig = SignatureConfig(),  # noqa: B008 (frozen)
    paper: bool = False,
    classes: ClassRule | None = None,
    attribute: list[str] | None = None,
    **options: Any,
) -> SignatureDataset:
    """The dataset that the options select; nothing is computed.

    Args:
        signature: parameters of the signatures.
        classes: what the class of a body is: folder (or labels.csv), body (its name in its file), or file.

    Raises:
        ValueError: `paper` beside other parameters of the signatures, or no classes where they are needed.
    """
    if paper and signature != SignatureConfig():
        raise ValueError("paper: expected no other parameters of the signatures beside it. Leave one out.")
    config, reading = SignatureConfig.paper() if paper else signature, LoadOptions(**options)
    if isinstance(source, Folder) and source.root.is_file() and not is_searched(source.root.name):
        if config != SignatureConfig() or reading != LoadOptions() or classes is not None or attribute:
            raise ValueError(f"{source.root}: expected no reading options beside a file of signatures. Leave them out.")
        if source.needs_meshes:
            raise ValueError(f"{source.root}: holds signatures and no meshes, which are needed. Give their folder.")
        dataset = SignatureDataset.from_file(source.root, descriptor=needs, cache_dir=cache_dir)
        if source.labelled and dataset.bodies.labels is None:
            raise ValueError(f"{source.root}: expected signatures with classes. Export those of a labelled folder.")
        if source.check is not None:
            source.check(dataset.bodies)
        return dataset
    attributes = attribute_sources(attribute or (), source.root if isinstance(source, Folder) else None)
    if isinstance(source, Folder):
        how: dict[str, Any] = {"classes": classes or "folder", "attributes": attributes.values()}
        bodies = find_bodies(source.root, reading, labelled=source.labelled, **how)
        if source.check is not None:
            source.check(bodies)
        source = bodies
    return SignatureDataset(
        source, config, cache_dir, descriptor=needs, classes=classes, reading=reading, attributes=attributes
    )


def mending_summary(dataset: SignatureDataset, n_given: int) -> str:
    """How many meshes were mended and by what, in one line; nothing where none was."""
    steps = [repair_steps(notes) for notes in dataset.all_notes()]
    counts = Counter(step for taken in steps for step in taken)
    if not counts:
        return ""
    n_mended = sum(bool(taken) for taken in steps)
    words = {"watertight": "made watertight"}
    told = ", ".join(f"{count} {words.get(step, step)}" for step, count in counts.most_common())
    return f"{n_mended} of {n_given} meshes were mended: {told}"


def write_notes(path: Path, dataset: SignatureDataset) -> None:
    """Write a table of what was done to which mesh."""
    notes = zip(dataset.bodies.names, dataset.all_notes(), strict=True)
    write_rows(path, ("name", "note"), [(name, note) for name, told in notes for note in told])
