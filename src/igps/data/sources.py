"""Sources of bodies and their classes: folders, tables of labels, lists of files."""

from __future__ import annotations

import csv
import io
import logging
import math
import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, get_args

from igps._files import delimiter_of, table_text
from igps.data.added_attributes import AttributeSource, FileSource
from igps.data.listing import Listing
from igps.mesh.formats import has_numbers, is_searched, searched_suffixes
from igps.mesh.loading import BodyRef
from igps.mesh.options import LoadOptions

logger = logging.getLogger(__name__)

LABELS_FILE = "labels.csv"

ClassRule = Literal["folder", "body", "file"]
"""Rule for the class of a body: from its folder or `labels.csv`, from the name of its part, or from its file."""


@dataclass(frozen=True)
class Bodies:
    """Bodies in files, with names, classes and further columns."""

    refs: tuple[BodyRef, ...]  # file of each body, and its name in the file
    # Unique: path of the file relative to the searched folder, and `#part` if it has a part
    names: tuple[str, ...]
    labels: tuple[str, ...] | None = None  # class of each body; None if there are no classes
    # Further columns of `labels.csv` by name, with one value for each body; None if a value is missing (empty, NA, ...)
    columns: Mapping[str, tuple[str | None, ...]] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        fields = {"names": self.names, "labels": self.labels, **self.columns}
        for name, values in fields.items():
            if values is not None and len(values) != len(self):
                raise ValueError(
                    f"{name}: expected one for each of {len(self)} bodies, got {len(values)}."
                )

    @cached_property
    def paths(self) -> tuple[Path, ...]:
        """File of each body."""
        return tuple(ref.path for ref in self.refs)

    @cached_property
    def parts(self) -> tuple[str | None, ...]:
        """Name of each body in its file; None if the file is one body."""
        return tuple(ref.part for ref in self.refs)

    def __len__(self) -> int:
        return len(self.refs)

    def __getitem__(self, index: int) -> BodyRef:
        return self.refs[index]

    def __iter__(self) -> Iterator[BodyRef]:
        return iter(self.refs)

    def number(self, name: str) -> int:
        """Return the index of a body by its name; raise a KeyError if there is no such body."""
        if name not in self.names:
            first = f"the first is called {self.names[0]!r}" if self.names else "there is none"
            raise KeyError(f"no body is called {name!r}; {first}")
        return self.names.index(name)

    def subset(self, indices: Sequence[int]) -> Bodies:
        """Return the bodies with these indices, in this order."""
        refs = tuple(self.refs[i] for i in indices)
        names = tuple(self.names[i] for i in indices)
        labels = self.labels and tuple(self.labels[i] for i in indices)
        columns = {}
        for name, values in self.columns.items():
            columns[name] = tuple(values[i] for i in indices)
        return Bodies(refs, names, labels, columns)

    def column(self, name: str) -> tuple[str, ...]:
        """Return the values of a column such as "scanner"; raise a ValueError if a body has no value."""
        if name not in self.columns:
            names = ", ".join(self.columns)
            remedy = "Choose one of them" if names else "Add it, in a line for each file"
            raise ValueError(
                f"{name}: no such column of {LABELS_FILE}; further columns: {names or 'none'}. {remedy}."
            )
        values = self.columns[name]
        missing = [body for body, value in zip(self.names, values, strict=True) if value is None]
        if missing:
            cause = (
                f"{name}: {len(missing)} of {len(self)} bodies have no value, such as {missing[0]}"
            )
            raise ValueError(
                f"{cause}. Fill the column of {LABELS_FILE}, or leave these bodies out."
            )
        return tuple(str(value) for value in values)

    def numbers(self, name: str) -> list[float]:
        """Return the values of a column such as "age" as numbers; raise a ValueError if one is not a finite number."""
        values = self.column(name)
        for body, value in zip(self.names, values, strict=True):
            if not is_number(value):
                raise ValueError(
                    f"{name}: expected numbers, got {value!r} of {body}. Correct it in {LABELS_FILE}."
                )
        return [float(value) for value in values]

    def with_classes(self, rule: ClassRule) -> Bodies:
        """Return the bodies with classes by a rule; "folder" keeps the classes."""
        if rule not in get_args(ClassRule):
            raise ValueError(f"classes: expected 'folder', 'body' or 'file', got {rule!r}.")
        if rule == "folder":
            return self
        if rule == "file":
            return replace(self, labels=tuple(map(file_name_of, self.names, self.parts)))
        if all(part is None for part in self.parts):
            raise ValueError(
                f"classes: expected files of several bodies with 'body', but {self.names[0]} is one body."
            )
        # Files without parts, for example because they cannot be read, have classes by their own names
        labels = []
        for path, part in zip(self.paths, self.parts, strict=True):
            stem, _, _ = path.name.partition(".")
            labels.append(part or stem)
        return replace(self, labels=tuple(labels))


def find_bodies(
    root: str | Path,
    options: LoadOptions | None = None,
    *,
    classes: ClassRule = "folder",
    attributes: Iterable[AttributeSource] = (),
    labelled: bool = False,
    cache_dir: Path | None = None,
) -> Bodies:
    """Find the bodies below a folder, with their classes if the folder has classes.

    The first layout that fits is used: a `labels.csv` with the columns `file,label` (paths relative to the folder) or
    `file,body,label` (an empty `body` stands for all bodies of the file); one folder per class; files without classes.
    Further columns of `labels.csv`, such as `age`, become `Bodies.columns`; beside them, `label` is optional.

    Args:
        options: options for reading files, which determine the bodies of a file.
        classes: rule for the class of a body.
        attributes: attribute sources, whose files are not used as bodies.
        labelled: whether classes are required.
        cache_dir: directory of the cache, in which the names of the bodies in a file are kept. If None, each file that
            may hold several is read.

    Raises:
        FileNotFoundError: the folder does not exist, or has no file that may be a body.
        ValueError: `labels.csv` is invalid, or there are no classes although they are required.
    """
    root = Path(root)
    listing = Listing(options or LoadOptions(), cache_dir)
    if not _is_utf8(root.absolute()):
        raise ValueError(f"{os.fsencode(root)!r}: expected a name in UTF-8. Rename the folder.")
    if not root.is_dir():
        fault = "expected a folder, got a file" if root.exists() else "no such folder"
        raise FileNotFoundError(f"{root}: {fault}. Check the path.")
    has_table = (root / LABELS_FILE).is_file()
    bodies = (
        _from_labels_file(root, listing) if has_table else _from_folder(root, listing, attributes)
    )
    bodies = bodies.with_classes(classes)
    if labelled and bodies.labels is None:
        other = (
            f" Or rename one of the columns {', '.join(bodies.columns)} to label."
            if bodies.columns
            else ""
        )
        raise ValueError(
            f"{root}: no classes found. Expected a folder per class or {LABELS_FILE} (file,label).{other}"
        )
    return bodies


def _from_folder(root: Path, listing: Listing, attributes: Iterable[AttributeSource]) -> Bodies:
    links = [
        path
        for path in root.iterdir()
        if path.is_symlink() and path.is_dir() and not path.name.startswith(".")
    ]
    files = sorted(path for folder in (root, *links) for path in _files_in(folder))
    excluded = {
        file
        for source in attributes
        if isinstance(source, FileSource)
        for file in source.files(files)
    }
    at_root = [path for path in files if path.parent == root and path not in excluded]
    nested = [path for path in files if path.parent != root and path not in excluded]
    files_of_bodies = nested or at_root
    if at_root and nested:
        ignored = f"{len(at_root)} files beside the folders of classes are ignored, such as {at_root[0].name}"
        logger.warning(
            "%s: %s. Put them into a folder, or list all in a %s.", root, ignored, LABELS_FILE
        )
    if not files_of_bodies:
        raise FileNotFoundError(
            f"{root}: no body found. Expected a folder per class, or files with a {LABELS_FILE} (file,label), "
            f"in one of the formats {', '.join(searched_suffixes())}."
        )
    rows = []
    for path in files_of_bodies:
        name = path.relative_to(root)
        rows.append(_Row(path, name.as_posix(), name.parts[0] if nested else None))
    return _bodies_of_rows(rows, listing)


def bodies_of_files(
    paths: Sequence[str | Path],
    labels: Sequence[str] | None = None,
    options: LoadOptions | None = None,
    cache_dir: Path | None = None,
) -> Bodies:
    """Return the bodies of files in their order. ``FILE#PART`` selects one body of a file. Labels are given by file."""
    files = [file_and_part(Path(path)) for path in paths]
    if not files:
        raise ValueError("paths: expected at least one mesh file, got none.")
    for file, _ in files:
        if not _is_utf8(file.absolute()):
            raise ValueError(
                f"paths: expected names in UTF-8, got {os.fsencode(file)!r}. Rename the file."
            )
    if labels is not None and len(labels) != len(files):
        raise ValueError(f"labels: expected one for each of {len(files)} files, got {len(labels)}.")
    rows = []
    for i, (file, part) in enumerate(files):
        label = None if labels is None else labels[i]
        rows.append(_Row(file, str(file), label, part))
    return _bodies_of_rows(rows, Listing(options or LoadOptions(), cache_dir))


def bodies_of(
    source: str | Path | Sequence[str | Path] | Bodies,
    labels: Sequence[str] | None = None,
    options: LoadOptions | None = None,
    attributes: Iterable[AttributeSource] = (),
    cache_dir: Path | None = None,
) -> Bodies:
    """Return the bodies of a folder or of files, see `find_bodies` and `bodies_of_files`; return `Bodies` unchanged."""
    has_labels = isinstance(source, Bodies) or (
        isinstance(source, str | Path) and Path(source).is_dir()
    )
    if labels is not None and has_labels:
        raise ValueError(
            f"labels: expected None with a folder or bodies, which have labels, got {len(labels)}."
        )
    if isinstance(source, Bodies):
        return source
    if not isinstance(source, str | Path):
        return bodies_of_files(source, labels, options, cache_dir)
    if Path(source).is_dir():
        return find_bodies(source, options, attributes=attributes, cache_dir=cache_dir)
    if not file_and_part(Path(source))[0].exists():
        raise FileNotFoundError(f"{source}: no such file or folder. Check the path.")
    return bodies_of_files([source], labels, options, cache_dir)


def file_and_part(path: Path) -> tuple[Path, str | None]:
    """Split ``FILE#PART``; the part is None if the whole path exists, or if no file precedes a "#"."""
    if os.path.exists(path):
        return path, None
    name = str(path)
    for mark in re.finditer("#", name):
        file = Path(name[: mark.start()])
        part = name[mark.end() :]
        if part and file.is_file():
            return file, part
    return path, None


def is_number(value: str | float | None) -> bool:
    """Return whether a value is missing or a finite number, without the underscores that Python allows (01_02)."""
    try:
        return value is None or ("_" not in str(value) and math.isfinite(float(value)))
    except ValueError:
        return False


def file_name_of(name: str, part: str | None) -> str:
    """Return the name of the file of a body, for the name and the part of the body."""
    return name if part is None else name.removesuffix(f"#{part}")


@dataclass(frozen=True)
class _Row:
    """A file of a collection, with one of its bodies or all of them."""

    path: Path
    name: str  # of the file
    label: str | None = None
    part: str | None = None  # the chosen body; None for all bodies of the file
    values: Mapping[str, str | None] = field(default_factory=dict)  # of further columns


def _from_labels_file(root: Path, listing: Listing) -> Bodies:
    file = root / LABELS_FILE
    text = table_text(file)
    with io.StringIO(text, newline="") as stream:
        reader = csv.DictReader(
            stream, delimiter=delimiter_of(text), skipinitialspace=True, restval=""
        )
        try:
            reader.fieldnames = [_column_name(name) for name in reader.fieldnames or ()]
            lines = [(reader.line_num, line) for line in reader]
        except csv.Error as error:
            raise ValueError(
                f"{file}: not readable as a table ({error}). Save it as CSV in UTF-8."
            ) from error
        header = [name for name in reader.fieldnames if name]
    further_columns = [name for name in header if name not in ("file", "body", "label")]
    if "file" not in header or not ("label" in header or further_columns):
        expected = "expected the columns file,label in the first line, separated by commas"
        raise ValueError(f"{file}: {expected}, got {header}.")
    if len(set(header)) < len(header):
        raise ValueError(
            f"{file}: a column is named twice in {header}. Give each column a name of its own."
        )
    rows = []
    for number, line in lines:
        if None in line:  # the key of values without a column
            raise ValueError(
                f"{file}: line {number} has more values than columns. Put a value with a comma in quotes."
            )
        values = {name: line[name].strip() for name in header}
        required = [values[name] for name in ("file", "label") if name in header]
        is_whole = all(required) and "\0" not in "".join(required)
        if not is_whole:
            cause = f"line {number} lacks the name of a file, or a label"
            raise ValueError(f"{file}: {cause}. Each line names a file and its class.")
        further = {name: _known_value(values[name]) for name in further_columns}
        name = values["file"]
        if os.path.isdir(root / name):
            raise ValueError(
                f"{file}: line {number} names the folder {name}. Give a line for each file in it."
            )
        part = values.get("body") or None
        rows.append(_Row(root / name, name, values.get("label"), part, further))
    if not rows:
        raise ValueError(f"{file}: no rows. Each line names a file and its class.")
    bodies = _bodies_of_rows(rows, listing)
    listed = set()
    for name, ref in zip(bodies.names, bodies, strict=True):
        place = (os.path.abspath(ref.path), ref.part)  # ./1.off is 1.off
        if place in listed:
            raise ValueError(f"{file}: {name} is listed twice. List each body once.")
        listed.add(place)
    return bodies


def _known_value(value: str) -> str | None:
    """Return the value of a table, None if it is missing, as R and pandas write it."""
    return None if value.lower() in ("", "na", "n/a", "nan") else value


def _column_name(name: str) -> str:
    """Return the name of a column without spaces around it; those with a meaning may be in any case."""
    name = name.strip()
    return name.lower() if name.lower() in ("file", "body", "label") else name


def _bodies_of_rows(rows: Sequence[_Row], listing: Listing) -> Bodies:
    """Return the bodies of all files in their order."""
    listed = listing.of(row.path for row in rows if row.part is None or has_numbers(row.path))
    _number_lone_labels(listed)
    refs = []
    names = []
    row_of_body = []
    for row in rows:
        found = listed.get(row.path, [])
        if row.part is not None:
            numbers = {name: ref.number for ref in found for name in (ref.number, ref.part)}
            found = [BodyRef(row.path, row.part, numbers.get(row.part))]
        for ref in found:
            refs.append(ref)
            names.append(row.name if ref.part is None else f"{row.name}#{ref.part}")
            row_of_body.append(row)
    labels = tuple(row.label for row in row_of_body if row.label is not None)
    return Bodies(
        tuple(refs),
        tuple(names),
        labels if len(labels) == len(refs) else None,
        {name: tuple(row.values[name] for row in row_of_body) for name in rows[0].values},
    )


def _number_lone_labels(listed: dict[Path, list[BodyRef]]) -> None:
    """Call the only label of a mask by its number if most files beside it have labels by numbers.

    A mask with the single label 1 is named after its file, as in a folder of organs. Among subjects with the labels 1
    and 2, that label is the same structure as theirs. Files alone in their folders are compared by their own names.
    """
    in_folder = Counter(path.parent for path in listed)
    groups: dict[object, list[Path]] = defaultdict(list)
    for path in listed:
        is_alone = in_folder[path.parent] == 1
        groups[path.name if is_alone else path.parent].append(path)
    for paths in groups.values():
        masks = []
        n_numbered = 0
        for path in paths:
            refs = listed[path]
            if all(ref.number is not None and ref.part == ref.number for ref in refs):
                n_numbered += 1
            elif len(refs) == 1 and path.name.startswith(f"{refs[0].part}."):
                masks.append(path)
        if n_numbered <= len(masks):
            continue
        for path in masks:
            number = listed[path][0].number
            listed[path] = [BodyRef(path, number, number)]


def _files_in(folder: Path) -> list[Path]:
    """Find files that may be bodies, except for hidden ones. Broken links are included, and fail when they are read."""
    message = "%s: this folder is left out (%s). Ask for the right to read it."

    def warn(error: OSError) -> None:
        logger.warning(message, error.filename, error.strerror)

    files = []
    for parent, folders, names in os.walk(folder, onerror=warn):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in names:
            path = Path(parent, name)
            if name.startswith(".") or not is_searched(path):
                continue
            is_pipe = path.exists() and not path.is_file()  # whose reading might never end
            if not _is_utf8(path):
                remedy = "Rename it, or set PYTHONUTF8=1"
                fault = f"{os.fsencode(path)!r}: left out, its name is not UTF-8"
                logger.warning("%s. %s.", fault, remedy)
            elif not is_pipe:
                files.append(path)
    return files


def _is_utf8(path: Path) -> bool:
    """Return whether the name of a file is valid UTF-8. Names from other systems may be arbitrary bytes."""
    return str(path).encode(errors="ignore").decode() == str(path)
