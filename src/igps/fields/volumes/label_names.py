"""Names of labels, from tables of ITK-SNAP, 3D Slicer, FreeSurfer, FSLeyes and nnU-Net, CSV, and NIfTI files.

The tables in `label_tables` name the labels of FreeSurfer 7 and of FastSurfer, which has the same numbers, by
FreeSurferColorLUT.txt, and those of TotalSegmentator, version 2 and version 1, task "total".
"""

import csv
import html
import json
import logging
import re
from collections.abc import Iterable
from pathlib import Path

from igps._files import delimiter_of, table_text
from igps.mesh.errors import MeshError

logger = logging.getLogger(__name__)

_SUFFIXES = (".label", ".ctbl", ".lut", ".txt", ".csv", ".tsv", ".json")  # of tables for one volume
_FOLDER_TABLES = ("FreeSurferColorLUT.txt", "dataset.json")  # for all volumes of a folder
# Columns of tables, those first that win
_LABEL_COLUMNS = ("labelvalue", "label", "index", "id", "value")
_NAME_COLUMNS = ("name", "label_name", "labelname")
_MAX_BYTES = 1 << 24
BUILT_IN = {
    path.stem: path for path in sorted(Path(__file__).with_name("label_tables").glob("*.csv"))
}
"""Tables of this package, by the names that stand for them."""
# ITK-SNAP: index, three colours, opacity, visibility, mesh visibility, "name".
_SNAP = re.compile(r'(\d+)(?:\s+[\d.]+){6}\s+"([^"]*)"')
# FSLeyes: index, three colours, name to the end of the line.
_FSLEYES = re.compile(r"(\d+)(?:\s+[\d.]+){3}\s+(?![\d.\s]*$)(.+)")
# 3D Slicer and FreeSurfer: index, name, colours; 3D Slicer quotes names, or writes _ for a space.
_COLOURS = re.compile(r'(\d+)\s+("[^"]*"|\S+)(?:\s+[\d.]+){3,4}')
_WORKBENCH = re.compile(rb"<Label\b([^>]*)>(.*?)</Label>", re.DOTALL)
_KEY = re.compile(rb"""\bKey\s*=\s*["'](\d+)["']""")


def read_label_names(path: str | Path) -> dict[int, str]:
    """Read a table of the names of labels.

    Supported are label descriptions of ITK-SNAP; colour tables of 3D Slicer, FreeSurfer and FSLeyes; JSON that maps
    numbers to names or names to numbers, at the top level or, as in nnU-Net, under "labels"; and CSV or TSV whose first
    line names a column of labels (label, LabelValue, index, id or value) and a column of names (name or label_name).

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(f"{folder}/names.txt").write_text("# FreeSurfer\\n17  Left-Hippocampus  220 216 20 0\\n")
        ...     read_label_names(f"{folder}/names.txt")
        {17: 'Left-Hippocampus'}

    Raises:
        MeshError: the file is missing, unreadable, or names no label.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise MeshError(
                f"{path}: {path.stat().st_size:,} bytes are too many for a table of names. Check the path."
            )
        text = table_text(path)
    except OSError as error:
        fault = f"{path}: the table of names is not readable ({error})"
        raise MeshError(f"{fault}. Check the path, or give {', '.join(BUILT_IN)}.") from error
    names = (
        _parse_json(text)
        if path.suffix.lower() == ".json"
        else _parse_csv(text) or _parse_lines(text)
    )
    if not names:
        tables = (
            "label descriptions of ITK-SNAP, a colour table of 3D Slicer, FreeSurfer or FSLeyes"
        )
        formats = f"{tables}, CSV with the columns label,name, or JSON from numbers to names"
        raise MeshError(f"{path}: names no label. Expected {formats}.")
    return names


def names_table(path: Path | None, names: str | None) -> Path | None:
    """Return the table that names the labels of a volume: `names`, else the table beside it, else a built-in table.

    A built-in table counts for files that neither hold names nor lie beside a table.
    """
    if names is not None and names not in BUILT_IN:
        return Path(names)
    beside = None if path is None else table_beside(path)
    return beside or BUILT_IN.get(names or "")


def table_beside(path: Path) -> Path | None:
    """Return the first readable table of names beside a volume: named like the volume, or for the folder; else None."""
    stem = re.sub(r"(\.seg)?\.[^.]+(\.gz)?$", "", path.name, flags=re.IGNORECASE)
    for name in (*(stem + suffix for suffix in _SUFFIXES), *_FOLDER_TABLES):
        table = path.with_name(name)
        if table != path and table.is_file():
            try:
                read_label_names(table)
                return table
            except MeshError as error:
                logger.info(
                    "%s: the file beside it is not used as a table of names: %s", path, error
                )
    return None


def names_in_extensions(contents: Iterable[bytes]) -> dict[int, str]:
    """Return the names of labels in NIfTI header extensions as Connectome Workbench and TotalSegmentator write them."""
    names: dict[int, str] = {}
    for content in contents:
        for attributes, name in _WORKBENCH.findall(content):
            key = _KEY.search(attributes)
            if key is not None:
                inner = re.sub(rb"<!\[CDATA\[(.*?)\]\]>", rb"\1", name, flags=re.DOTALL)
                names[int(key[1])] = html.unescape(inner.decode("utf-8", "replace"))
    return cleaned(names)


def cleaned(names: dict[int, str]) -> dict[int, str]:
    """Put each name on one line, and drop empty names and those of the background."""
    lines = {label: " ".join(name.split()) for label, name in names.items()}
    return {label: name for label, name in lines.items() if name and label > 0}


def _parse_lines(text: str) -> dict[int, str]:
    names = {}
    for line in text.splitlines():
        line = line.strip()
        row = _SNAP.match(line) or _FSLEYES.match(line) or _COLOURS.match(line)
        if row is not None:
            names[int(row[1])] = row[2].strip('"')
    return cleaned(names)


def _parse_csv(text: str) -> dict[int, str]:
    rows = csv.DictReader(text.splitlines(), delimiter=delimiter_of(text))
    columns = {(column or "").strip().lower(): column for column in rows.fieldnames or ()}
    of_labels = [columns[key] for key in _LABEL_COLUMNS if key in columns]
    of_names = [columns[key] for key in _NAME_COLUMNS if key in columns]
    if not of_labels or not of_names:
        return {}
    labels = of_labels[0]
    names = of_names[0]
    numbered: dict[int, str] = {}
    for row in rows:
        number = _whole_number(str(row[labels] or ""))
        if number is not None:
            numbered[number] = str(row[names] or "")
    return cleaned(numbered)


def _parse_json(text: str) -> dict[int, str]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    table = content.get("labels", content) if isinstance(content, dict) else {}
    rows = table.items() if isinstance(table, dict) else ()
    numbered: dict[int, str] = {}
    for key, value in rows:
        label, name = (value, key) if isinstance(value, int | float) else (key, value)
        number = _whole_number(str(label))
        if number is not None and isinstance(name, str):
            numbered[number] = name
    return cleaned(numbered)


def _whole_number(text: str) -> int | None:
    """Return the label that a text names, such as "3", or "3.0" from a spreadsheet; None if it names none."""
    match = re.fullmatch(r"([0-9]+)(\.0*)?", text.strip())
    return int(match[1]) if match else None
