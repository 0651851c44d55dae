"""Two processes write to a gallery and are killed at random times; it holds all finished changes, no partial one."""

import sys
import tempfile
import time
from pathlib import Path

from outcome import Row

sys.path.append(str(Path(__file__).parents[1] / "gallery"))
from test_table import killed_writers


def campaign(n_kills):
    """Kill both writers again and again."""
    start = time.monotonic()
    n_rounds = max(n_kills // 2, 1)
    with tempfile.TemporaryDirectory(prefix="igps-campaign-") as folder:
        n_wrong = killed_writers(Path(folder) / "gallery", n_rounds)
    missed = [f"{n_wrong} galleries hold a change in part"] if n_wrong else []
    return [
        Row(
            "gallery",
            "two processes that write to one",
            2 * n_rounds,
            "whole changes, and no row of others is touched",
            f"{n_rounds - n_wrong} of {n_rounds} whole",
            missed,
            seconds=time.monotonic() - start,
        )
    ]
