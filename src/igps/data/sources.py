"""Sources of bodies and their classes: folders, tables of labels, lists of files."""

from __future__ import annotations

import csv
import io
import logging
import math
import os
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
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

    paths: tuple[Path, ...]  # file of each body
    # Unique: path of the file relative to the searched folder, and `#part` if it has a part
    names: tuple[str, ...]
    labels: tuple[str, ...] | None = None  # class of each body; None if there are no classes
    # Name of each body in its file; None if the file is one body
    parts: tuple[str | None, ...] = ()
    # Further columns of `labels.csv` by name, with one value for each body; None if a value is missing (empty, NA, ...)
    columns: Mapping[str, tuple[str | None, ...]] = field(default_factory=dict, hash=False)
    # Number of each label in its file, which names do not change; None for other bodies
    label_numbers: tuple[str | None, ...] = ()

    def __post_init__(self) -> None:
        if not self.parts:
            object.__setattr__(self, "parts", (None,) * len(self.paths))
        if not self.label_numbers:
            object.__setattr__(self, "label_numbers", (None,) * len(self.paths))
        fields = (
            ("names", self.names),
            ("labels", self.labels),
            ("parts", self.parts),
            ("label_numbers", self.label_numbers),
            *self.columns.items(),
        )
        for name, values in fields:
            if values is not None and len(values) != len(self.paths):
                raise ValueError(
                    f"{name}: expected one for each of {len(self.paths)} files, got {len(values)}."
                )

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> BodyRef:
        return BodyRef(self.paths[index], self.parts[index], self.label_numbers[index])

    def __iter__(self) -> Iterator[BodyRef]:
        return map(BodyRef, self.paths, self.parts, self.label_numbers)

    def number(self, name: str) -> int:
        """Return the index of a body by its name; raise a KeyError if there is no such body."""
        if name not in self.names:
            raise KeyError(f"no body is called {name!r}; the first is called {self.names[:1]}")
        return self.names.index(name)

    def subset(self, indices: Sequence[int]) -> Bodies:
        """Return the bodies with these indices, in this order."""
        return Bodies(
            tuple(self.paths[i] for i in indices),
            tuple(self.names[i] for i in indices),
            None if self.labels is None else tuple(self.labels[i] for i in indices),
            tuple(self.parts[i] for i in indices),
            {name: tuple(values[i] for i in indices) for name, values in self.columns.items()},
            tuple(self.label_numbers[i] for i in indices),
        )

    def column(self, name: str) -> tuple[str, ...]:
        """Return the values of a column such as "scanner"; raise a ValueError if a body has no value."""
        if name not in self.columns:
            names = ", ".join(self.columns) or "none"
            raise ValueError(
                f"{name}: no such column of {LABELS_FILE}; further columns: {names}. Choose one of them."
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
        stems = [path.name.partition(".")[0] for path in self.paths]
        return replace(
            self, labels=tuple(part or stem for part, stem in zip(self.parts, stems, strict=True))
        )


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
        raise FileNotFoundError(
            f"{root}: {'expected a folder, got a file' if root.exists() else 'no such folder'}."
        )
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
    if at_root and nested:
        ignored = f"{len(at_root)} files beside the folders of classes are ignored, such as {at_root[0].name}"
        logger.warning(
            "%s: %s. Put them into a folder, or list all in a %s.", root, ignored, LABELS_FILE
        )
    names = [(path, path.relative_to(root)) for path in nested or at_root]
    if not names:
        raise FileNotFoundError(
            f"{root}: no body found. Expected a folder per class, or files with a {LABELS_FILE} (file,label), "
            f"in one of the formats {', '.join(searched_suffixes())}."
        )
    rows = [
        (path, name.as_posix(), name.parts[0] if nested else None, None) for path, name in names
    ]
    return _bodies_in_files(rows, listing)


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
    if invalid := [file for file, _ in files if not _is_utf8(file.absolute())]:
        raise ValueError(
            f"paths: expected names in UTF-8, got {os.fsencode(invalid[0])!r}. Rename the file."
        )
    if labels is not None and len(labels) != len(files):
        raise ValueError(f"labels: expected one for each of {len(files)} files, got {len(labels)}.")
    classes: Sequence[str | None] = [None] * len(files) if labels is None else list(labels)
    rows = [
        (file, str(file), label, part) for (file, part), label in zip(files, classes, strict=True)
    ]
    return _bodies_in_files(rows, Listing(options or LoadOptions(), cache_dir))


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
    name = str(path)
    marks = [] if os.path.exists(path) else [i for i, letter in enumerate(name) if letter == "#"]
    for i in marks:
        if name[i + 1 :] and (file := Path(name[:i])).is_file():
            return file, name[i + 1 :]
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


def _from_labels_file(root: Path, listing: Listing) -> Bodies:
    file = root / LABELS_FILE
    text = table_text(file)
    with io.StringIO(text, newline="") as stream:
        reader = csv.DictReader(
            stream, delimiter=delimiter_of(text), skipinitialspace=True, restval=""
        )
        try:
            reader.fieldnames = [_column_name(name) for name in reader.fieldnames or ()]
            rows = [
                (reader.line_num, {name: "".join(value).strip() for name, value in row.items()})
                for row in reader
            ]
        except csv.Error as error:
            raise ValueError(
                f"{file}: not readable as a table ({error}). Save it as CSV in UTF-8."
            ) from error
        header = [name for name in reader.fieldnames if name]
        further_columns = [name for name in header if name not in ("file", "body", "label")]
        if "file" not in header or not ("label" in header or further_columns):
            expected = "expected the columns file,label in the first line, separated by commas"
            raise ValueError(f"{file}: {expected}, got {reader.fieldnames}.")
        if len(set(header)) < len(header):
            raise ValueError(
                f"{file}: a column is named twice in {header}. Give each column a name of its own."
            )
    if long := [line for line, row in rows if row.get(None)]:  # the key of values without a column
        raise ValueError(
            f"{file}: line {long[0]} has more values than columns. Put a value with a comma in quotes."
        )
    required = {"file", "label"} & {*header}
    invalid = [
        line for line, row in rows if any("\0" in (row.get(name) or "\0") for name in required)
    ]
    if not rows or invalid:
        cause = f"line {invalid[0]} lacks the name of a file, or a label" if invalid else "no rows"
        raise ValueError(f"{file}: {cause}. Each line names a file and its class.")
    missing = ("", "na", "n/a", "nan")  # as R and pandas write it
    columns = {
        name: [None if row[name].lower() in missing else row[name] for _, row in rows]
        for name in further_columns
    }
    files = [
        (root / row["file"], row["file"], row.get("label"), row.get("body") or None)
        for _, row in rows
    ]
    bodies = _bodies_in_files(files, listing, columns)
    # ./1.off is 1.off
    counts = Counter(keys := [(os.path.abspath(body.path), body.part) for body in bodies])
    if duplicates := sorted(
        name for name, key in zip(bodies.names, keys, strict=True) if counts[key] > 1
    ):
        raise ValueError(f"{file}: {duplicates[0]} is listed twice. List each body once.")
    return bodies


def _column_name(name: str) -> str:
    """Return the name of a column without spaces around it; those with a meaning may be in any case."""
    name = name.strip()
    return name.lower() if name.lower() in ("file", "body", "label") else name


def _bodies_in_files(
    rows: Sequence[tuple[Path, str, str | None, str | None]],
    listing: Listing,
    columns: Mapping[str, Sequence[str | None]] | None = None,
) -> Bodies:
    """Return the bodies of files, given by path, name, label and part; without a part, all bodies of the file."""
    listed = listing.of(path for path, _, _, part in rows if part is None or has_numbers(path))
    _number_lone_labels(listed)
    entries: list[tuple[int, Path, str, str | None, str | None, str | None]] = []
    for i, (path, name, label, chosen) in enumerate(rows):
        refs = listed.get(path, [])
        if chosen is not None:
            numbers = {key: ref.number for ref in refs for key in (ref.number, ref.part)}
            refs = [BodyRef(path, chosen, numbers.get(chosen))]
        for ref in refs:
            full_name = name if ref.part is None else f"{name}#{ref.part}"
            entries.append((i, path, full_name, label, ref.part, ref.number))
    indices, paths, names, labels, parts, numbers_of = zip(*entries, strict=True)
    body_columns = {
        name: tuple(values[i] for i in indices) for name, values in (columns or {}).items()
    }
    known_labels = None if None in labels else labels
    return Bodies(paths, names, known_labels, parts, body_columns, numbers_of)


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
    files = []
    for parent, folders, names in os.walk(
        folder, onerror=lambda e: logger.warning(message, e.filename, e.strerror)
    ):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for path in (
            Path(parent, name)
            for name in names
            if not name.startswith(".") and is_searched(Path(parent, name))
        ):
            if not _is_utf8(path):
                remedy = "Rename it, or set PYTHONUTF8=1"
                fault = f"{os.fsencode(path)!r}: left out, its name is not UTF-8"
                logger.warning("%s. %s.", fault, remedy)
            elif os.path.isfile(path) or not os.path.exists(
                path
            ):  # not a pipe, whose reading might never end
                files.append(path)
    return files


def _is_utf8(path: Path) -> bool:
    """Return whether the name of a file is valid UTF-8. Names from other systems may be arbitrary bytes."""
    return str(path).encode(errors="ignore").decode() == str(path)
