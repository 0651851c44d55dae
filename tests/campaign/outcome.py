"""What a part of the campaign found, one row for each thing that it promises."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass
class Row:
    """One line of the table.

    Args:
        part: of the campaign.
        what: was tried.
        tried: how many times.
        target: in words.
        measured: in words.
        missed: a sentence for each miss of the target, with what repeats it; none where the target is met.
        notes: what a reader should know, beside that.
        details: numbers, for the JSON file.
        seconds: of wall time.
    """

    part: str
    what: str
    tried: int
    target: str
    measured: str
    missed: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def met(self) -> bool:
        """Whether the target was met."""
        return not self.missed

    def as_dict(self) -> dict[str, Any]:
        """The row for a JSON file."""
        return {**asdict(self), "met": self.met}


def table(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table, and below it what was missed and what is to be known."""
    header = ("part", "what", "tried", "target", "measured", "met", "s")
    lines = [
        (
            row.part,
            row.what,
            f"{row.tried:,}",
            row.target,
            row.measured,
            "yes" if row.met else "NO",
            f"{row.seconds:.0f}",
        )
        for row in rows
    ]
    widths = [max(len(line[i]) for line in (header, *lines)) for i in range(len(header))]

    def written(line: Sequence[str]) -> str:
        return "| " + " | ".join(word.ljust(width) for word, width in zip(line, widths, strict=True)) + " |"

    text = [written(header), written(["-" * width for width in widths]), *map(written, lines)]
    for row in rows:
        text += [f"MISSED {row.part}, {row.what}: {miss}" for miss in row.missed]
        text += [f"note   {row.part}, {row.what}: {note}" for note in row.notes]
    return "\n".join(text)
