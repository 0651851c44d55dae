"""The campaign: broken meshes and other bodies, kills, a machine at fault, properties, deliberate faults.

It prints a table, writes it to a JSON file, and ends with status 1 where a target is missed.
"""

from __future__ import annotations

import argparse
import importlib
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

# Before anything reads it: workers and runs side by side have one thread each.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from outcome import Row, table

# How much of each part: the whole campaign, and the small one of two minutes. None leaves a part out.
_AMOUNTS: dict[str, tuple[int, int | None]] = {
    "broken_meshes": (10_000, 200),
    "broken_bodies": (3_000, 90),
    "kills": (200, 8),
    "gallery_kills": (200, 8),
    "machine_faults": (0, None),
    "properties": (12, 1),
    "mutants": (20, None),
}


# One after the other; and side by side, those of a line in turn. Most kills and all properties keep one core busy.
_ORDER = (
    (("broken_meshes",),),
    (("broken_bodies",),),
    (("kills",), ("properties", "machine_faults", "gallery_kills")),
    (("mutants",),),
)


def _run(part: str, amount: int) -> list[Row]:
    run: Callable[..., list[Row]] = importlib.import_module(part).campaign
    start, before = time.monotonic(), os.times()
    rows = run(amount) if amount else run()
    processors = sum(os.times()[:4]) - sum(before[:4])
    print(f"{part}: {time.monotonic() - start:.0f} s of wall time, {processors:.0f} s of processors", flush=True)
    return rows


def _line(parts: Sequence[tuple[str, int]]) -> dict[str, list[Row]]:
    """Each part in a process of its own.

    Those that a part starts and kills have nothing to do with those of another, such as the helper of multiprocessing
    that counts semaphores.
    """
    found = {}
    for part, amount in parts:
        with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as process:
            found[part] = process.submit(_run, part, amount).result()
    return found


def main() -> None:
    """Run the campaign, or parts of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="the one of two minutes")
    parser.add_argument("--parts", nargs="+", choices=_AMOUNTS, default=list(_AMOUNTS), help="of the campaign")
    parser.add_argument("--out", type=Path, default=Path("build/campaign.json"), help="JSON file of the table")
    arguments = parser.parse_args()
    amounts = {part: amount[arguments.small] for part, amount in _AMOUNTS.items()}
    found: dict[str, list[Row]] = {}
    for lines in _ORDER:
        wanted = [[(part, amounts[part]) for part in line if part in arguments.parts] for line in lines]
        wanted = [[(part, amount) for part, amount in line if amount is not None] for line in wanted]
        wanted = [line for line in wanted if line]
        if not wanted:
            continue
        print(f"{', '.join(part for line in wanted for part, _ in line)} ...", flush=True)
        with ProcessPoolExecutor(len(wanted), multiprocessing.get_context("fork")) as processes:
            for rows_of in processes.map(_line, wanted):
                found |= rows_of
    rows = [row for part in _AMOUNTS for row in found.get(part, [])]
    print(table(rows))
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps([row.as_dict() for row in rows], indent=2) + "\n")
    sys.exit(not all(row.met for row in rows))


if __name__ == "__main__":
    main()
