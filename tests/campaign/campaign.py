"""The campaign: broken meshes and other bodies, killed processes, faults of the machine, properties.

It prints a table of the results, writes it to a JSON file, and ends with status 1 if a target is missed.
"""

import argparse
import importlib
import json
import multiprocessing
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

# One thread for each of the parallel processes. Libraries read this variable when they are imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from outcome import table

# Number of cases of each part, in the whole campaign and in the small one of two minutes. None leaves a part out.
_AMOUNTS = {
    "broken_meshes": (10_000, 200),
    "broken_bodies": (3_000, 90),
    "changed_streams": (2_000, 20),
    "kills": (200, 8),
    "gallery_kills": (60, 8),
    "machine_faults": (0, None),
    "properties": (12, 1),
}


# Stages run one after the other. The lines of a stage run in parallel, the parts of a line one after the other. Most
# kills and all properties keep one core busy.
_STAGES = (
    (("broken_meshes",),),
    (("broken_bodies",), ("changed_streams",)),
    (("kills",), ("properties", "machine_faults", "gallery_kills")),
)


def _run(part, amount):
    run = importlib.import_module(part).campaign
    start = time.monotonic()
    before = os.times()
    rows = run(amount) if amount else run()
    processors = sum(os.times()[:4]) - sum(before[:4])
    print(
        f"{part}: {time.monotonic() - start:.0f} s of wall time, {processors:.0f} s of processors",
        flush=True,
    )
    return rows


def _line(parts):
    """Run the parts of a line, each in a separate process.

    So parts do not share the processes that they start and kill, such as the resource tracker of multiprocessing.
    """
    results = {}
    for part, amount in parts:
        with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as process:
            results[part] = process.submit(_run, part, amount).result()
    return results


def main():
    """Run the campaign, or parts of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="run the campaign of two minutes")
    parser.add_argument(
        "--parts", nargs="+", choices=_AMOUNTS, default=list(_AMOUNTS), help="parts to run"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("build/campaign.json"), help="JSON file of the table"
    )
    arguments = parser.parse_args()
    amounts = {part: amount[arguments.small] for part, amount in _AMOUNTS.items()}
    results = {}
    for stage in _STAGES:
        lines = [
            [(part, amounts[part]) for part in line if part in arguments.parts] for line in stage
        ]
        lines = [[(part, amount) for part, amount in line if amount is not None] for line in lines]
        lines = [line for line in lines if line]
        if not lines:
            continue
        print(f"{', '.join(part for line in lines for part, _ in line)} ...", flush=True)
        with ProcessPoolExecutor(len(lines), multiprocessing.get_context("fork")) as processes:
            for line_results in processes.map(_line, lines):
                results |= line_results
    rows = [row for part in _AMOUNTS for row in results.get(part, [])]
    print(table(rows))
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps([row.as_dict() for row in rows], indent=2) + "\n")
    sys.exit(not all(row.met for row in rows))


if __name__ == "__main__":
    main()
