"""What can go wrong with a job, and whether the job or the machine is at fault."""

import errno
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, CancelledError
from dataclasses import dataclass
from typing import TypeVar

Result = TypeVar("Result")

_KILLED_ON_CLUSTER = "several workers that had it were killed. It may need more memory: start workers with more memory."
_REMEDIES = {
    "Free disk space": ("ENOSPC", "EDQUOT", "EFBIG"),
    "Choose a writable folder": ("EROFS", "EACCES", "EPERM"),
    "Check the disk": ("EIO",),
    "Raise the limit of open files": ("EMFILE", "ENFILE"),
    "Free memory": ("ENOMEM",),
}


class MachineError(RuntimeError):
    """The machine is at fault, not a job: for example, the disk is full. Finished results are kept."""


@dataclass(frozen=True)
class Failed:
    """The outcome of a job that failed."""

    reason: str  # in one sentence
    # What the body is, if such failures are counted and not listed, see `MeshError.summary`
    summary: str = ""

    @staticmethod
    def of(error: Exception) -> "Failed":
        """Return the outcome of a job that raised an error."""
        is_told = isinstance(error, ValueError)  # its message is a sentence
        reason = str(error) if is_told else f"{type(error).__name__}: {error}"
        return Failed(reason, getattr(error, "summary", ""))


@dataclass(frozen=True)
class Limits:
    """Limits of one job; None is no limit."""

    seconds: float | None = None  # wall time
    memory: int | None = None  # bytes of data of the process; enforced only on Linux

    def __post_init__(self) -> None:
        for name, value in (("time_limit", self.seconds), ("memory_limit", self.memory)):
            if value is not None and not value > 0:
                raise ValueError(f"{name}: expected None or a positive number, got {value}.")


def machine_error(error: BaseException) -> MachineError | None:
    """Return an error, with a remedy, if the machine is at fault: a full or broken disk, a missing permission."""
    name = errno.errorcode.get(getattr(error, "errno", None) or 0)
    for remedy, names in _REMEDIES.items():
        if name in names:
            return MachineError(f"{error}. {remedy} and run again: finished results are kept.")
    return None


def attempt(function: Callable[[], Result], limits: Limits = Limits()) -> Result | Failed:
    """Return the result or the failure of a job; raise a MachineError if the machine is at fault."""
    try:
        return function()
    except (BrokenExecutor, CancelledError, MachineError):
        raise
    except MemoryError as error:
        if limits.memory is not None:
            return Failed(
                f"it needs more than the memory_limit of {limits.memory / 2**20:.0f} MiB."
            )
        raise MachineError(
            "out of memory. Use fewer workers or a memory limit: finished results are kept."
        ) from error
    except ImportError as error:
        raise MachineError(
            f"{str(error).rstrip('.')}. Install it and run again: finished results are kept."
        ) from error
    except OSError as error:
        fault = machine_error(error)
        if fault is not None:
            raise fault from error
        return Failed.of(error)
    except Exception as error:
        # Dask raises KilledWorker after several workers died with the same job.
        is_killed = type(error).__name__ == "KilledWorker"
        return Failed(_KILLED_ON_CLUSTER) if is_killed else Failed.of(error)
