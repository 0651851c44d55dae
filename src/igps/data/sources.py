"""Where bodies and their classes come from."""

from __future__ import annotations

import csv
import logging
import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

from igps.data.attributes import AttributeSource, FromFiles
from igps.mesh.formats import is_searched, searched_suffixes
from igps.mesh.loading import BodyRef, list_bodies
from igps.mesh.mesh import MeshError
from igps.mesh.options import LoadOptions

logger = logging.getLogger(__name__)

LABELS_FILE = "labels.csv"

ClassRule = Literal["folder", "body", "file"]
"""What the class of a body is: what its folder or `labels.csv` says, the name of its part, or its file."""


@dataclass(frozen=True)
class Bodies:
    """Bodies in files, and what is known of them."""

    paths: tuple[Path, ...]  # the file of each
    names: tuple[str, ...]  # distinct: the path of the file relative to the folder it was found in, and `#part`
    labels: tuple[str, ...] | None = None  # the class of each, or None where no classes are known
    parts: tuple[str | None, ...] = ()  # which body of its file each is; None in a file that is one body
    # Further columns of the table of labels by name, a value for each body; None where it is missing
    columns: Mapping[str, tuple[str | None, ...]] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        if not self.parts:
            object.__setattr__(self, "parts", (None,) * len(self.paths))
        given = (("names", self.names), ("labels", self.labels), ("parts", self.parts), *self.columns.items())
        for name, values in given:
            if values is not None and len(values) != len(self.paths):
                raise ValueError(f"{name}: expected one for each of {len(self.paths)} files, got {len(values)}.")

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, index: int) -> BodyRef:
        return BodyRef(self.paths[index], self.parts[index])

    def __iter__(self) -> Iterator[BodyRef]:
        return map(BodyRef, self.paths, self.parts)

    def number(self, name: str) -> int:
        """Of the body of a name; a KeyError where none is called so."""
        if name not in self.names:
            raise KeyError(f"no body is called {name!r}; the first is called {self.names[:1]}")
        return self.names.index(name)

    def subset(self, indices: Sequence[int]) -> Bodies:
        """Some of the bodies, in the given order."""
        return Bodies(
            tuple(self.paths[i] for i in indices),
            tuple(self.names[i] for i in indices),
            None if self.labels is None else tuple(self.labels[i] for i in indices),
            tuple(self.parts[i] for i in indices),
            {name: tuple(values[i] for i in indices) for name, values in self.columns.items()},
        )

    def column(self, name: str) -> tuple[str, ...]:
        """The values of a column that every body has, such as of "scanner"; a ValueError where one has none."""
        if name not in self.columns:
            known = ", ".join(self.columns) or "none"
            raise ValueError(f"{name}: no such column of {LABELS_FILE}; further columns: {known}. Choose one of them.")
        values = self.columns[name]
        missing = [body for body, value in zip(self.names, values, strict=True) if value is None]
        if missing:
            raise ValueError(
                f"{name}: {len(missing)} of {len(self)} bodies have no value, such as {missing[0]}. Fill the column of "
                f"{LABELS_FILE}, or leave these bodies out."
            )
        return tuple(str(value) for value in values)

    def numbers(self, name: str) -> list[float]:
        """The values of a column of numbers, such as of "age"; a ValueError of what is no finite number."""
        values = self.column(name)
        for body, value in zip(self.names, values, strict=True):
            if not is_number(value):
                raise ValueError(f"{name}: expected numbers, got {value!r} of {body}. Correct it in {LABELS_FILE}.")
        return [float(value) for value in values]

    def with_classes(self, rule: ClassRule) -> Bodies:
        """The same bodies with the classes that a rule gives them; "folder" leaves them as they are."""
        if rule not in get_args(ClassRule):
            raise ValueError(f"classes: expected 'folder', 'body' or 'file', got {rule!r}.")
        if rule == "folder":
            return self
        if rule == "file":
            return replace(self, labels=tuple(map(file_name_of, self.names, self.parts)))
        if all(part is None for part in self.parts):
            raise ValueError(f"classes: expected files of several bodies with 'body', but {self.names[0]} is one body.")
        # A file that cannot be read, such as an empty mask, has no parts; and costs the others nothing
        words = [path.name.partition(".")[0] for path in self.paths]
        return replace(self, labels=tuple(part or word for part, word in zip(self.parts, words, strict=True)))


def find_bodies(
    root: str | Path,
    options: LoadOptions | None = None,
    *,
    classes: ClassRule = "folder",
    attributes: Iterable[AttributeSource] = (),
    labelled: bool = False,
) -> Bodies:
    """The bodies below a folder, with their classes if it tells them.

    Three layouts are known: files and a `labels.csv` with the columns `file,label` (paths relative to the folder), or
    `file,body,label`, where an empty `body` stands for every body of the file; one folder per class; files alone,
    without classes. The first that fits is taken. Further columns of `labels.csv`, such as `scanner` or `age`, become
    `Bodies.columns`; beside them, `label` may be missing where the folder tells no classes.

    Args:
        options: how files are read, which says what bodies there are in one.
        attributes: values inside the bodies; their files are not taken as bodies.
        labelled: whether it must tell classes.

    Raises:
        FileNotFoundError: the folder does not exist, or holds no file that may be a body.
        ValueError: `labels.csv` cannot be understood, or it has no classes where they are needed.
    """
    root, options = Path(root), options or LoadOptions()
    if not _is_utf8(root.absolute()):
        raise ValueError(f"{os.fsencode(root)!r}: a name in UTF-8 expected. Rename the folder.")
    if not root.is_dir():
        raise FileNotFoundError(f"{root}: {'a file; a folder expected' if root.exists() else 'no such folder'}.")
    table = (root / LABELS_FILE).is_file()
    bodies = _from_labels_file(root, options) if table else _from_folder(root, options, attributes)
    bodies = bodies.with_classes(classes)
    if labelled and bodies.labels is None:
        other = f" Or call one of {', '.join(bodies.columns)} label." if bodies.columns else ""
        expected = f"Expected one folder per class, or a {LABELS_FILE} (file,label)."
        raise ValueError(f"{root}: no classes found. {expected}{other}")
    return bodies


def _from_folder(root: Path, options: LoadOptions, attributes: Iterable[AttributeSource]) -> Bodies:
    linked = [path for path in root.iterdir() if path.is_symlink() and path.is_dir() and not path.name.startswith(".")]
    files = sorted(path for folder in (root, *linked) for path in _files_in(folder))
    beside = {file for one in attributes if isinstance(one, FromFiles) for file in one.files(files)}
    alone = [path for path in files if path.parent == root and path not in beside]
    nested = [path for path in files if path.parent != root and path not in beside]
    if alone and nested:
        told = f"{len(alone)} files beside the folders of classes are left out, such as {alone[0].name}"
        logger.warning("%s: %s. Put them into a folder, or list all in a %s.", root, told, LABELS_FILE)
    found = [(path, path.relative_to(root)) for path in nested or alone]
    if not found:
        raise FileNotFoundError(
            f"{root}: no mesh found. Expected a folder per class, or mesh files with a {LABELS_FILE} (file,label), "
            f"in one of the formats {', '.join(searched_suffixes())}."
        )
    rows = [(path, name.as_posix(), name.parts[0] if nested else None, None) for path, name in found]
    return _expanded(rows, options)


def given_bodies(
    paths: Sequence[str | Path], labels: Sequence[str] | None = None, options: LoadOptions | None = None
) -> Bodies:
    """The bodies of the given files, in the given order, with the classes given to the files.

    ``FILE#PART`` names one body of a file of several.
    """
    files = [file_and_part(Path(path)) for path in paths]
    if not files:
        raise ValueError("paths: expected at least one mesh file, got none.")
    if unknown := [file for file, _ in files if not _is_utf8(file.absolute())]:
        raise ValueError(f"paths: expected names in UTF-8, got {os.fsencode(unknown[0])!r}. Rename the file.")
    if labels is not None and len(labels) != len(files):
        raise ValueError(f"labels: expected one for each of {len(files)} files, got {len(labels)}.")
    classes: Sequence[str | None] = [None] * len(files) if labels is None else list(labels)
    rows = [(file, str(file), label, part) for (file, part), label in zip(files, classes, strict=True)]
    return _expanded(rows, options or LoadOptions())


def bodies_of(
    given: str | Path | Sequence[str | Path] | Bodies,
    labels: Sequence[str] | None = None,
    options: LoadOptions | None = None,
    attributes: Iterable[AttributeSource] = (),
) -> Bodies:
    """`find_bodies` of a folder, `given_bodies` of files, and bodies as they are; a FileNotFoundError of neither."""
    if labels is not None and (isinstance(given, Bodies) or (isinstance(given, str | Path) and Path(given).is_dir())):
        raise ValueError(f"labels: expected None beside a folder or bodies, which tell theirs, got {len(labels)}.")
    if isinstance(given, Bodies):
        return given
    if isinstance(given, str | Path) and not file_and_part(Path(given))[0].exists():
        raise FileNotFoundError(f"{given}: no such file or folder. Check the path.")
    if isinstance(given, str | Path) and Path(given).is_dir():
        return find_bodies(given, options, attributes=attributes)
    return given_bodies([given] if isinstance(given, str | Path) else given, labels, options)


def file_and_part(path: Path) -> tuple[Path, str | None]:
    """The file and the part of ``FILE#PART``; no part where a file has this name, or none has what stands before."""
    name = str(path)
    for at in [] if os.path.exists(path) else [i for i, letter in enumerate(name) if letter == "#"]:
        if name[at + 1 :] and (file := Path(name[:at])).is_file():
            return file, name[at + 1 :]
    return path, None


def is_number(value: str | float | None) -> bool:
    """Whether a value is missing or a finite number; 01_02, a number to Python, is a word."""
    try:
        return value is None or ("_" not in str(value) and math.isfinite(float(value)))
    except ValueError:
        return False


def file_name_of(name: str, part: str | None) -> str:
    """The name of the file of a body, by the name of the body."""
    return name if part is None else name.removesuffix(f"#{part}")


def _parts(path: Path, options: LoadOptions) -> Sequence[str | None]:
    """The bodies of a file by name; None where it is one body, or cannot be read, which is told when it is computed."""
    try:
        return [body.part for body in list_bodies(path, options)] or [None]
    except MeshError:
        return [None]


def _from_labels_file(root: Path, options: LoadOptions) -> Bodies:
    file = root / LABELS_FILE
    with file.open(newline="", encoding="utf-8-sig") as stream:
        reader = csv.DictReader(stream, skipinitialspace=True, restval="")
        try:
            reader.fieldnames = [name.strip() for name in reader.fieldnames or ()]
            rows = [(reader.line_num, {name: "".join(value).strip() for name, value in row.items()}) for row in reader]
        except (UnicodeDecodeError, csv.Error) as error:
            raise ValueError(f"{file}: not readable as a table ({error}). Save it as CSV in UTF-8.") from error
        header = [name for name in reader.fieldnames if name]
        further = [name for name in header if name not in ("file", "body", "label")]
        if "file" not in header or not ("label" in header or further):
            expected = "expected the columns file,label in the first line, separated by commas"
            raise ValueError(f"{file}: {expected}, got {reader.fieldnames}.")
        if len(set(header)) < len(header):
            raise ValueError(f"{file}: a column is named twice in {header}. Give each column a name of its own.")
    if longer := [line for line, row in rows if row.get(None)]:  # under which stands what has no column
        raise ValueError(f"{file}: line {longer[0]} has more values than columns. Put a value with a comma in quotes.")
    empty = [line for line, row in rows if any("\0" in (row.get(one) or "\0") for one in {"file", "label"} & {*header})]
    if not rows or empty:
        where = f"line {empty[0]} lacks the name of a file, or a label" if empty else "no rows"
        raise ValueError(f"{file}: {where}. Each line names a mesh file and its class.")
    columns = {name: [row.get(name) or None for _, row in rows] for name in further}
    found = [(root / row["file"], row["file"], row.get("label"), row.get("body") or None) for _, row in rows]
    bodies = _expanded(found, options, columns)
    counts = Counter(places := [(os.path.abspath(body.path), body.part) for body in bodies])  # ./1.off is 1.off
    if twice := sorted(name for name, place in zip(bodies.names, places, strict=True) if counts[place] > 1):
        raise ValueError(f"{file}: {twice[0]} is listed twice. List each body once.")
    return bodies


def _expanded(
    rows: Sequence[tuple[Path, str, str | None, str | None]],
    options: LoadOptions,
    columns: Mapping[str, Sequence[str | None]] | None = None,
) -> Bodies:
    """The bodies of files, each with its name, class and part; of a file without a part, all that it holds."""
    found = [
        (i, path, name if part is None else f"{name}#{part}", label, part)
        for i, (path, name, label, given) in enumerate(rows)
        for part in ([given] if given is not None else _parts(path, options))
    ]
    numbers, paths, names, labels, parts = zip(*found, strict=True)
    of_bodies = {name: tuple(values[i] for i in numbers) for name, values in (columns or {}).items()}
    return Bodies(paths, names, None if None in labels else labels, parts, of_bodies)


def _files_in(folder: Path) -> list[Path]:
    """Files that may be bodies, without hidden ones; links that lead nowhere stay, to be told when they are read."""
    refused = "%s: left out with all that is in it (%s). Ask for the right to read it."
    found = []
    for place, folders, names in os.walk(folder, onerror=lambda e: logger.warning(refused, e.filename, e.strerror)):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for path in (Path(place, name) for name in names if not name.startswith(".") and is_searched(name)):
            if not _is_utf8(path):
                logger.warning("%s: left out, its name is not UTF-8. Rename it.", os.fsencode(path))
            elif os.path.isfile(path) or not os.path.exists(path):  # reading a pipe might never end
                found.append(path)
    return found


def _is_utf8(path: Path) -> bool:
    """Whether the name of a file is text: names from other systems may be bytes that are not UTF-8."""
    return str(path).encode(errors="ignore").decode() == str(path)
