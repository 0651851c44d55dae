"""The campaign: broken meshes and other bodies, and killed processes.

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

# Number of cases of each part, in the whole campaign and in the small one of a minute.
_AMOUNTS = {
    "broken_meshes": (10_000, 200),
    "broken_bodies": (3_000, 90),
    "kills": (200, 8),
}


def _run(part, amount):
    """Run a part in a process of its own: it does not share what another starts and kills."""
    run = importlib.import_module(part).campaign
    start = time.monotonic()
    before = os.times()
    rows = run(amount)
    processors = sum(os.times()[:4]) - sum(before[:4])
    seconds = time.monotonic() - start
    print(f"{part}: {seconds:.0f} s of wall time, {processors:.0f} s of processors", flush=True)
    return rows


def main():
    """Run the campaign, or parts of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="run the campaign of a minute")
    parser.add_argument(
        "--parts", nargs="+", choices=_AMOUNTS, default=list(_AMOUNTS), help="parts to run"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("build/campaign.json"), help="JSON file of the table"
    )
    arguments = parser.parse_args()
    rows = []
    for part in arguments.parts:
        amount = _AMOUNTS[part][arguments.small]
        print(f"{part} ...", flush=True)
        with ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as process:
            rows += process.submit(_run, part, amount).result()
    print(table(rows))
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps([row.as_dict() for row in rows], indent=2) + "\n")
    sys.exit(not all(row.met for row in rows))


if __name__ == "__main__":
    main()
