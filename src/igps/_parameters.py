"""Checks of parameters, with uniform messages. None is accepted where the type allows it."""

import math
from collections.abc import Collection


def check_at_least(minimum: int, **values: int | None) -> None:
    """Raise a ValueError for the first value that is smaller than `minimum` or not a whole number."""
    for name, value in values.items():
        if value is not None and not hasattr(value, "__index__"):
            raise ValueError(f"{name}: expected a whole number, got {value!r}.")
        if value is not None and value < minimum:
            raise ValueError(f"{name}: expected at least {minimum}, got {value}.")


def check_seed(seed: int) -> None:
    """Raise a ValueError unless every library that draws random numbers accepts a seed."""
    if not 0 <= seed < 2**32:
        raise ValueError(f"seed: expected 0 to {2**32 - 1}, got {seed}.")


def check_positive(**values: float) -> None:
    """Raise a ValueError for the first value that is not a finite number above 0."""
    for name, value in values.items():
        if not 0 < value < math.inf:
            raise ValueError(f"{name}: expected a positive number, got {value}.")


def check_fraction(**values: float | None) -> None:
    """Raise a ValueError for the first value that is not strictly between 0 and 1."""
    for name, value in values.items():
        if value is not None and not 0 < value < 1:
            raise ValueError(f"{name}: expected a number between 0 and 1, got {value}.")


def check_one_of(allowed: Collection[str | None], **values: str | None) -> None:
    """Raise a ValueError for the first value that is not allowed."""
    for name, value in values.items():
        if value not in allowed:
            raise ValueError(
                f"{name}: expected one of {', '.join(map(str, allowed))}, got {value!r}."
            )
