"""Names of labels: by a table of ITK-SNAP, 3D Slicer, FreeSurfer, FSLeyes, nnU-Net, by CSV, or of NIfTI or MGH."""

import csv
import html
import io
import json
import logging
import re
from collections.abc import Iterable
from pathlib import Path

from igps.mesh.mesh import MeshError

logger = logging.getLogger(__name__)

_SUFFIXES = (".label", ".ctbl", ".lut", ".txt", ".csv", ".tsv", ".json")  # of tables for a volume
_BESIDE = ("FreeSurferColorLUT.txt", "dataset.json")  # for all volumes of a folder
_MOST_BYTES = 1 << 24
# ITK-SNAP: index, three colours, opacity, visibility, mesh visibility, "name".
_SNAP = re.compile(r'(\d+)(?:\s+[\d.]+){6}\s+"([^"]*)"')
# FSLeyes: index, three colours, name to the end of the line.
_FSLEYES = re.compile(r"(\d+)(?:\s+[\d.]+){3}\s+(?![\d.\s]*$)(.+)")
# 3D Slicer and FreeSurfer: index, name, colours; 3D Slicer quotes names, or has _ for a space.
_COLOURS = re.compile(r'(\d+)\s+("[^"]*"|\S+)(?:\s+[\d.]+){3,4}')
_WORKBENCH = re.compile(rb"<Label\b([^>]*)>(.*?)</Label>", re.DOTALL)
_KEY = re.compile(rb"""\bKey\s*=\s*["'](\d+)["']""")
_COLOUR_TABLE, _NEW_LAYOUT = 1, -2  # in an MGH file


def read_label_names(path: str | Path) -> dict[int, str]:
    """The names that a table gives to labels.

    Label descriptions of ITK-SNAP, colour tables of 3D Slicer, FreeSurfer and FSLeyes, JSON from numbers to names or
    back, also under "labels" as nnU-Net has it, and CSV or TSV whose first line names a column of labels (label,
    LabelValue, index, id or value) and one of names (name or label_name).

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
        if path.stat().st_size > _MOST_BYTES:
            raise MeshError(f"{path}: {path.stat().st_size:,} bytes are no table of names. Give the table.")
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise MeshError(f"{path}: the names of labels are not readable ({error}). Check the path.") from error
    names = _of_json(text) if path.suffix.lower() == ".json" else _of_csv(text) or _of_lines(text)
    if not names:
        raise MeshError(
            f"{path}: names no label. Expected label descriptions of ITK-SNAP, a colour table of 3D Slicer, "
            "FreeSurfer or FSLeyes, CSV with the columns label,name, or JSON from numbers to names."
        )
    return names


def table_beside(path: Path) -> Path | None:
    """The first table of names beside a volume: under its name, or of FreeSurfer or nnU-Net for the folder; or none."""
    stem = re.sub(r"(\.seg)?\.[^.]+(\.gz)?$", "", path.name, flags=re.IGNORECASE)
    for name in (*(stem + suffix for suffix in _SUFFIXES), *_BESIDE):
        table = path.with_name(name)
        if table != path and table.is_file():
            try:
                read_label_names(table)
                return table
            except MeshError as error:
                logger.info("%s: no names from the file beside it: %s", path, error)
    return None


def names_in_extensions(contents: Iterable[bytes]) -> dict[int, str]:
    """Those in the extensions of a NIfTI header, as Connectome Workbench and TotalSegmentator write them; or none."""
    names: dict[int, str] = {}
    for content in contents:
        for attributes, name in _WORKBENCH.findall(content):
            if key := _KEY.search(attributes):
                inner = re.sub(rb"<!\[CDATA\[(.*?)\]\]>", rb"\1", name, flags=re.DOTALL)
                names[int(key[1])] = html.unescape(inner.decode("utf-8", "replace"))
    return cleaned(names)


def names_in_tags(content: bytes) -> dict[int, str]:
    """Those of the colour table among the tags at the end of an MGH file, as FreeSurfer writes it; or none.

    Big-endian numbers: a tag and the bytes that follow it, but for the table, which begins at once.
    """
    stream = io.BytesIO(content)

    def number(size: int = 4) -> int:
        return int.from_bytes(stream.read(size), "big", signed=True)  # 0 at the end

    def words() -> bytes:
        return stream.read(max(number(), 0))

    while (tag := number()) not in (0, _COLOUR_TABLE):
        stream.seek(min(max(number(8), 0), len(content)), io.SEEK_CUR)
    names: dict[int, str] = {}
    if tag and number() == _NEW_LAYOUT:
        number(), words()  # the largest label, the file of the table
        for _ in range(min(number(), len(content) // 24)):  # a label without a name takes as many bytes
            label, name = number(), words()
            names[label] = name.rstrip(b"\0").decode("utf-8", "replace")
            stream.read(16)  # the colour
    return cleaned(names)


def cleaned(names: dict[int, str]) -> dict[int, str]:
    """On one line each, without those that are empty, and without the background."""
    words = {label: " ".join(name.split()) for label, name in names.items()}
    return {label: name for label, name in words.items() if name and label > 0}


def _of_lines(text: str) -> dict[int, str]:
    lines = (line.strip() for line in text.splitlines())
    rows = (_SNAP.match(line) or _FSLEYES.match(line) or _COLOURS.match(line) for line in lines)
    return cleaned({int(row[1]): row[2].strip('"') for row in rows if row})


def _of_csv(text: str) -> dict[int, str]:
    lines = text.splitlines()
    rows = csv.DictReader(lines, delimiter="\t" if lines and "\t" in lines[0] else ",")
    columns = {(column or "").strip().lower(): column for column in rows.fieldnames or ()}
    number = next((columns[key] for key in ("labelvalue", "label", "index", "id", "value") if key in columns), None)
    name = next((columns[key] for key in ("name", "label_name", "labelname") if key in columns), None)
    if number is None or name is None:
        return {}
    pairs = ((str(row[number] or "").strip(), str(row[name] or "")) for row in rows)
    return cleaned({int(label): words for label, words in pairs if _is_number(label)})


def _of_json(text: str) -> dict[int, str]:
    try:
        content = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    table = content.get("labels", content) if isinstance(content, dict) else {}
    rows = table.items() if isinstance(table, dict) else ()
    pairs = ((value, key) if isinstance(value, int) else (key, value) for key, value in rows)
    return cleaned({int(label): name for label, name in pairs if _is_number(str(label)) and isinstance(name, str)})


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdigit()
