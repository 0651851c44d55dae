"""Tables of the pages, written from files of results that record command, versions, date and processor.

python -m docs.benchmarks.tables NAME KIND RESULTS "COMMAND"
"""

import datetime
import json
import platform
import re
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from textwrap import wrap
from typing import Any

from jsonargparse import auto_cli

from igps.cli import errors_as_messages
from igps.report.tables import TITLES
from igps.signature.signature import SignatureConfig

PAGES = Path(__file__).parent
RESULTS = PAGES / "results"
_WIDTH = 120  # of lines of prose
_PLACEHOLDER = re.compile(r"(<!-- results: (\w+) -->\n).*?(<!-- end of results -->)", re.DOTALL)

Table = tuple[list[str], list[list[str]]]
"""Titles of the columns, and the cells of each row."""


def scores(source: Path) -> Table:
    """Read the results of `igps compare --out`: a row for each descriptor, scores in percent."""
    columns = ("nn", "ft", "st", "dcg", "adr_self", "map")
    rows = []
    for row in _read(source, "compare.json"):
        percents = [_percent(row[name]) for name in columns]
        rows.append([f"`{row['descriptor']}`", *percents, f"{row['seconds_per_mesh']:.2f}"])
    return ["descriptor", *(TITLES[name] for name in columns), "s/body"], rows


def splits(source: Path) -> Table:
    """Read the results of `python -m docs.benchmarks.learning splits --out`: a row for each head."""
    rows = []
    for row in _read(source, "splits.json"):
        spreads = [_spread(row[name]) for name in ("ft", "nn", "dcg")]
        rows.append([f"{row['descriptor']}, {row['protocol']}", row["head"], *spreads])
    return ["descriptor, classes", "head", "FT", "NN", "DCG"], rows


KINDS: Mapping[str, Callable[[Path], Table]] = {"scores": scores, "splits": splits}
"""Readers of results by the kind of table."""


def record(name: str, kind: str, source: Path, command: str) -> None:
    """Save a table with command, versions, date and processor, and write it into the pages that show it.

    Args:
        name: name of the table in the pages.
        kind: scores or splits.
        source: folder or file of results.
        command: command that produced the results.

    Raises:
        ValueError: the kind is unknown.
    """
    if kind not in KINDS:
        raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}.")
    columns, rows = KINDS[kind](source)
    results = {
        "command": command,
        "version": version("interior-gps"),
        "signatures": SignatureConfig.ALGORITHM_VERSION,
        "date": datetime.date.today().isoformat(),
        "processor": _processor(),
        "columns": columns,
        "rows": rows,
    }
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / f"{name}.json").write_text(
        json.dumps(results, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
    )
    write_pages()


def write_pages() -> None:
    """Write every table into the pages that show it."""
    for page in sorted(PAGES.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        filled = with_tables(text)
        if filled != text:
            page.write_text(filled, encoding="utf-8")


def with_tables(text: str) -> str:
    """Fill the placeholders in a page, `<!-- results: NAME -->`, with the saved tables."""
    return _PLACEHOLDER.sub(lambda match: f"{match[1]}\n{markdown(match[2])}\n{match[3]}", text)


def table_names(text: str) -> list[str]:
    """Return the names of the tables that a page shows."""
    return [match[2] for match in _PLACEHOLDER.finditer(text)]


def load_results(name: str) -> dict[str, Any]:
    """Load the results saved under a name, see `record`."""
    results: dict[str, Any] = json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))
    return results


def markdown(name: str) -> str:
    """Format the table of a name, followed by a line about its origin."""
    results = load_results(name)
    lines = [
        _row(results["columns"]),
        _row(["---"] * len(results["columns"])),
        *map(_row, results["rows"]),
    ]
    code = f"version {results['version']}, signatures {results['signatures']}"
    origin = f"{code}, {results['date']}, {results['processor']}"
    return "\n".join([*lines, "", *wrap(f"`{results['command']}`: {origin}.", _WIDTH)]) + "\n"


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.1f}"


def _spread(values: Mapping[str, float]) -> str:
    return f"{100 * values['mean']:.1f} ± {100 * values['stdev']:.1f}"


def _read(source: Path, name: str) -> Any:
    return json.loads((source / name if source.is_dir() else source).read_text(encoding="utf-8"))


def _processor() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        text = ""
    names = re.findall(r"^model name\s*:\s*(.*)$", text, re.MULTILINE)
    if names:
        return f"{len(names)} cores of {names[0]}"
    return platform.processor() or platform.machine()


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(record)
