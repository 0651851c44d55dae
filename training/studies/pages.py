"""Tables of the documentation: each is written from a file of results, which says by what and when it was measured."""

import datetime
import json
import platform
import re
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from textwrap import wrap
from typing import Any

from igps.report.tables import TITLES
from igps.signature.signature import SignatureConfig

DOCS = Path(__file__).parents[2] / "docs"
RESULTS = DOCS / "benchmarks" / "results"
_WIDTH = 120  # of lines of prose
_PLACE = re.compile(r"(<!-- results: (\w+) -->\n).*?(<!-- end of results -->)", re.DOTALL)

Table = tuple[list[str], list[list[str]]]
"""Titles of the columns, and the cells of each row."""


def scores(source: Path) -> Table:
    """Of `igps compare --out`: a row a descriptor, scores in percent."""
    shown = ("nn", "ft", "st", "dcg", "adr_self", "map")
    rows = [
        [f"`{row['descriptor']}`", *(_percent(row[name]) for name in shown), f"{row['seconds_per_mesh']:.2f}"]
        for row in _read(source, "compare.json")
    ]
    return ["descriptor", *(TITLES[name] for name in shown), "s/body"], rows


def splits(source: Path) -> Table:
    """Of `python -m training.evaluate splits --out`: a row a head, mean and standard deviation over splits."""
    found = _read(source, "splits.json")
    rows = [
        [f"{row['descriptor']}, {row['protocol']}", row["head"], *(_spread(row[name]) for name in ("ft", "nn", "dcg"))]
        for row in found
    ]
    return ["descriptor, classes", "head", "FT", "NN", "DCG"], rows


KINDS: Mapping[str, Callable[[Path], Table]] = {"scores": scores, "splits": splits}
"""What a table can be made of, by name."""


def record(name: str, kind: str, source: Path, command: str) -> None:
    """Keep a table with the versions, the date and the processor, and write it into the pages that show it.

    Args:
        name: of the table, as pages name it.
        kind: scores or splits.
        source: the folder or file of results.
        command: what was run.

    Raises:
        ValueError: there is no such kind.
    """
    if kind not in KINDS:
        raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}.")
    columns, rows = KINDS[kind](source)
    kept = {
        "command": command,
        "version": version("interior-gps"),
        "signatures": SignatureConfig.ALGORITHM_VERSION,
        "date": datetime.date.today().isoformat(),
        "processor": _processor(),
        "columns": columns,
        "rows": rows,
    }
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / f"{name}.json").write_text(json.dumps(kept, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    write_pages()


def write_pages() -> None:
    """Write every table into the pages that show it."""
    for page in sorted(DOCS.rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        filled = with_tables(text)
        if filled != text:
            page.write_text(filled, encoding="utf-8")


def with_tables(text: str) -> str:
    """A page whose places for results, `<!-- results: NAME -->`, hold the tables that are kept under these names."""
    return _PLACE.sub(lambda place: f"{place[1]}\n{markdown(place[2])}\n{place[3]}", text)


def shown(text: str) -> list[str]:
    """The names of the results that a page shows."""
    return [place[2] for place in _PLACE.finditer(text)]


def kept(name: str) -> dict[str, Any]:
    """The results of a name, see `record`."""
    found: dict[str, Any] = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return found


def markdown(name: str) -> str:
    """The table of a name, and a line that says what measured it."""
    results = kept(name)
    lines = [_row(results["columns"]), _row(["---"] * len(results["columns"])), *map(_row, results["rows"])]
    by = f"version {results['version']}, signatures {results['signatures']}, {results['date']}, {results['processor']}"
    return "\n".join([*lines, "", *wrap(f"`{results['command']}`: {by}.", _WIDTH)]) + "\n"


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f}"


def _spread(of: Mapping[str, float]) -> str:
    return f"{100 * of['mean']:.1f} ± {100 * of['stdev']:.1f}"


def _read(source: Path, name: str) -> Any:
    return json.loads((source / name if source.is_dir() else source).read_text(encoding="utf-8"))


def _processor() -> str:
    try:
        told = re.findall(r"^model name\s*:\s*(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        told = []
    return f"{len(told)} cores of {told[0]}" if told else platform.processor() or platform.machine()
