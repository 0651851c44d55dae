"""Where meshes and their classes come from."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from igps.mesh.formats import is_searched, searched_suffixes

LABELS_FILE = "labels.csv"


@dataclass(frozen=True)
class Bodies:
    """Mesh files and what is known of them.

    Args:
        paths: the files.
        names: a distinct name for each, its path relative to the folder it was found in.
        labels: the class of each, or None where no classes are known.
    """

    paths: tuple[Path, ...]
    names: tuple[str, ...]
    labels: tuple[str, ...] | None

    def __len__(self) -> int:
        return len(self.paths)

    def subset(self, indices: Sequence[int]) -> Bodies:
        """Some of the files, in the given order."""
        return Bodies(
            tuple(self.paths[i] for i in indices),
            tuple(self.names[i] for i in indices),
            None if self.labels is None else tuple(self.labels[i] for i in indices),
        )


def find_bodies(root: str | Path) -> Bodies:
    """The meshes below a folder, with their classes if it tells them.

    Three layouts are known: meshes and a `labels.csv` with the columns `file,label` (paths relative to the folder); one
    folder per class; meshes alone, without classes. The first that fits is taken.

    Raises:
        FileNotFoundError: the folder does not exist, or holds no mesh.
        ValueError: `labels.csv` cannot be understood.
    """
    root = Path(root)
    if not root.is_dir():
        raise FileNotFoundError(f"{root}: no such folder.")
    if (root / LABELS_FILE).is_file():
        return _from_labels_file(root)
    folders = sorted(p for p in root.iterdir() if p.is_dir() and not p.name.startswith("."))
    in_classes = [(path, folder.name) for folder in folders for path in _meshes_in(folder)]
    if in_classes:
        paths, labels = zip(*in_classes, strict=True)
        return Bodies(paths, _names(paths, root), labels)
    paths = tuple(_meshes_in(root))
    if not paths:
        raise FileNotFoundError(
            f"{root}: no mesh found. Expected a folder per class, or mesh files with a {LABELS_FILE} (file,label), "
            f"in one of the formats {', '.join(searched_suffixes())}."
        )
    return Bodies(paths, _names(paths, root), None)


def labelled_bodies(root: str | Path) -> Bodies:
    """`find_bodies` of a folder that tells classes.

    Raises:
        ValueError: it tells none.
    """
    files = find_bodies(root)
    if files.labels is None:
        raise ValueError(f"{root}: no classes found. Expected one folder per class, or a {LABELS_FILE} (file,label).")
    return files


def given_bodies(paths: Sequence[str | Path], labels: Sequence[str] | None = None) -> Bodies:
    """The given files, in the given order, with the given classes.

    Raises:
        ValueError: no file, or not one label for each.
    """
    files = tuple(Path(path) for path in paths)
    if not files:
        raise ValueError("paths: expected at least one mesh file, got none.")
    if labels is not None and len(labels) != len(files):
        raise ValueError(f"labels: expected one for each of {len(files)} files, got {len(labels)}.")
    return Bodies(files, tuple(str(path) for path in files), None if labels is None else tuple(labels))


def _from_labels_file(root: Path) -> Bodies:
    file = root / LABELS_FILE
    with file.open(newline="", encoding="utf-8-sig") as stream:
        reader = csv.DictReader(stream)
        if not reader.fieldnames or not {"file", "label"} <= set(reader.fieldnames):
            raise ValueError(f"{file}: expected the columns file,label in the first line, got {reader.fieldnames}.")
        rows = [(row["file"], row["label"]) for row in reader]
    incomplete = [i for i, (name, label) in enumerate(rows, start=2) if not name or not label]
    if not rows or incomplete:
        where = f"line {incomplete[0]} lacks a file or a label" if incomplete else "no rows"
        raise ValueError(f"{file}: {where}. Each line names a mesh file and its class.")
    names = [name for name, _ in rows]
    twice = sorted(name for name, count in Counter(names).items() if count > 1)
    if twice:
        raise ValueError(f"{file}: {twice[0]} is listed twice. List each mesh once.")
    return Bodies(tuple(root / name for name in names), tuple(names), tuple(label for _, label in rows))


def _meshes_in(folder: Path) -> list[Path]:
    return sorted(
        path for path in folder.rglob("*") if is_searched(path) and not path.name.startswith(".") and path.is_file()
    )


def _names(paths: Sequence[Path], root: Path) -> tuple[str, ...]:
    return tuple(path.relative_to(root).as_posix() for path in paths)
