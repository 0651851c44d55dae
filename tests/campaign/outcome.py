"""Results of the parts of the campaign: one row for each target."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass
class Row:
    """One line of the table.

    Args:
        part: name of the part of the campaign.
        what: the subject of the trials.
        tried: number of trials.
        target: the target, in words.
        measured: the result, in words.
        missed: a sentence for each miss of the target, with the means to repeat it; empty if the target is met.
        notes: further remarks for the reader.
        details: numbers, for the JSON file.
        seconds: wall time.
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
    def met(self):
        """Whether the target was met."""
        return not self.missed

    def as_dict(self):
        """The row for a JSON file."""
        return {**asdict(self), "met": self.met}


def table(rows):
    """Format rows as a Markdown table, followed by the misses and notes."""
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

    def formatted(line):
        return (
            "| "
            + " | ".join(word.ljust(width) for word, width in zip(line, widths, strict=True))
            + " |"
        )

    text = [
        formatted(header),
        formatted(["-" * width for width in widths]),
        *map(formatted, lines),
    ]
    for row in rows:
        text += [f"MISSED {row.part}, {row.what}: {miss}" for miss in row.missed]
        text += [f"note   {row.part}, {row.what}: {note}" for note in row.notes]
    return "\n".join(text)
