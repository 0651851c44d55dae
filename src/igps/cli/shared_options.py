"""The options that commands share, and what a command may return. Nothing here imports another package."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal, get_type_hints

from igps._parameters import check_positive
from igps.failures import Limits
from igps.mesh.options import LoadOptions
from igps.signature.config import SignatureConfig

Size = Literal["auto", "keep", "ignore"]
Mirror = Literal["auto", "same", "distinct"]
ClassRule = Literal["folder", "body", "file"]


@dataclass(frozen=True)
class Verdict:
    """The result of a command, and whether its exit status is 0."""

    result: Any
    is_good: bool


@dataclass(frozen=True)
class Option:
    """An option of the command line."""

    name: str  # without its dashes
    hint: Any  # type of its value
    help: str
    default: Any = None  # only for the help


def limits_of(seconds: float | None, gigabytes: float | None) -> Limits:
    """Return the limits of one body; raise a ValueError that names the option if a number is not positive."""
    limits = {"time_limit": seconds, "memory_limit": gigabytes}
    check_positive(**{name: limit for name, limit in limits.items() if limit is not None})
    return Limits(seconds, None if gigabytes is None else int(gigabytes * 1e9))


_LOAD_HELP = {
    "mend": (
        "auto: repair a surface as little as possible; never: refuse a surface that bounds no body; "
        "always: make watertight what crosses itself or does not bound a single body"
    ),
    "allow_open": "accept surfaces with holes; the winding number then tells inside from outside",
    "bodies": (
        "what counts as a body: the whole file, the labels of a volume, the objects of a scene or a CAD "
        "file, connected pieces, or the chains, models or assembly of a molecule; by default labels or "
        "chains where the format has them, and otherwise the whole file"
    ),
    "max_unpacked": "largest unpacked size of a file, in bytes",
    "names": (
        "table of label names; or freesurfer, totalsegmentator or totalsegmentator_v1, for volumes with no names in "
        "them or beside them"
    ),
    "threshold": (
        "smallest value of the voxels of a body: in volumes of probabilities, by default 0.5, and in density "
        "maps, which need it"
    ),
    "cavities": "fill hollow bodies, or keep the surfaces of hollows as part of their boundary",
    "first_model": "take only the first model of each file of molecules",
    "min_plddt": (
        "leave out residues of predicted molecules whose pLDDT, in place of the B-factor, is lower, such as 70"
    ),
}

_SIGNATURE_HELP = {
    "n_eigenpairs": "number of eigenpairs; by default as many as the descriptor needs",
    "resolution": "voxels along the longest side of a body",
    "min_samples": "the grid is refined until this many voxels lie inside; 0 never refines it",
    "n_surface_samples": "number of random samples of the surface",
    "backend": "cotangent matrices, or robust ones for triangles that are slivers",
    "max_vertices": "simplify meshes with more vertices; by default none",
    "accuracy": "largest relative error of 99 percent of the interior distances; none for exact distances",
    "attributes": "values to compute at the samples",
    "seed": "seed of the surface samples and of the eigensolver",
    "measures": "also compute plain numbers, for commands that do not print them",
    "least_vertices": "subdivide meshes with fewer vertices; by default two more than the eigenpairs",
}

_COLLECTION = (
    Option(
        "paper", bool, "use the parameters of Rustamov 2010: 250 eigenpairs, a grid never refined"
    ),
    Option(
        "classes",
        ClassRule,
        "class of a body: its folder or its entry in labels.csv, its name in its file (body), or its "
        "file; by default folder",
    ),
    Option(
        "attribute",
        list[str],
        "values inside the bodies, such as ct=images/{stem}.nii.gz: a file below the folder with an "
        "image, a grid, or values at vertices; {stem}, {file} and {part} are replaced by those of each body",
    ),
    Option("cache_dir", Path, "folder of the cache; by default the user's cache directory"),
)

_RUNNING = (
    Option("n_workers", int, "number of worker processes; by default one for each core"),
    Option(
        "complete",
        bool,
        "leave out bodies that reach the border of their image, where the scan may have cut them",
    ),
    Option("strict", bool, "stop at the first body that cannot be used instead of skipping it"),
    Option("time_limit", float, "seconds that one body may take; by default no limit"),
    Option(
        "memory_limit", float, "gigabytes of memory that one body may take; by default no limit"
    ),
)

_COMPARING = (
    Option(
        "size",
        Size,
        "keep or ignore differences in size; auto, the default, keeps them if all files have a unit of "
        "length",
    ),
    Option(
        "mirror",
        Mirror,
        "treat mirror images as distinct or the same; auto, the default, is the same, unless the "
        "descriptor's name has +side",
    ),
)


def _of_dataclass(kind: type, help_of: Mapping[str, str], prefix: str = "") -> tuple[Option, ...]:
    """Return the fields of a dataclass as options."""
    hints = get_type_hints(kind)
    return tuple(
        Option(prefix + field.name, hints[field.name], help_of[field.name], field.default)
        for field in fields(kind)
    )


SIGNATURE = "signature."
_LOAD = _of_dataclass(LoadOptions, _LOAD_HELP)
_SIGNATURE = _of_dataclass(SignatureConfig, _SIGNATURE_HELP, SIGNATURE)


def _by_name(options: Iterable[Option]) -> dict[str, Option]:
    return {option.name: option for option in options}


GROUPS: Mapping[str, Mapping[str, Option]] = {
    "load": _by_name(_LOAD),
    "collection": _by_name((*_LOAD, *_COLLECTION, *_SIGNATURE)),
    "reading": _by_name((*_LOAD, *_COLLECTION, *_SIGNATURE, *_RUNNING)),
    "describing": _by_name((*_LOAD, *_COLLECTION, *_SIGNATURE, *_RUNNING, *_COMPARING)),
}
"""Shared options by the name of the parameter that collects them: a command with `**reading` has those of `reading`.

`load` says how a file is read, `collection` what the bodies of a folder are, `reading` also how their signatures are
computed, and `describing` also how their descriptions are compared.
"""

SHARED = GROUPS["describing"]

COMMON = (
    *("bodies", "mend", "names", "classes", "attribute", "cache_dir", "n_workers"),
    *("size", "mirror"),
)
"""The shared options that the help of each command shows; `igps help options` shows all."""

WITH = Option(
    "with",
    list[str],
    "attributes to combine with the descriptor, such as ct, or ct=0.5 for half the weight of shape",
)
JSON = Option("json", bool, "print the table as JSON, and everything else to standard error")
OPTIONS = Option("options", Path, "YAML file of the options that igps help options lists, by name")

MEANINGS = {
    "root": "folder of bodies, with or without classes",
    "descriptor": "a name, as in igps help descriptors, or a file, or package.module:NAME of your own",
    "gallery": "folder of the gallery",
}
"""Help of options that the docstring of their command leaves out."""
