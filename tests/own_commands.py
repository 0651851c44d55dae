"""Commands of the tests' own."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def wait() -> None:
    """Wait until somebody presses Ctrl-C."""
    raise KeyboardInterrupt


def ask() -> None:
    """Ask for a pebibyte."""
    np.empty(2**47)


def pose(
    mesh: Path, classes: list[int] | None = None, exact: bool = False, length: float = 2.0
) -> None:
    """Draw a pose.

    Args:
        mesh: what to draw.
        classes: which to show.
        exact: without a tolerance
        length: in inches.
    """
    print(mesh, classes, exact, length)
