"""`igps precompute` and `igps cache`."""

import contextlib
import logging
import re
from collections.abc import Iterator
from concurrent.futures import Executor
from functools import reduce
from operator import or_
from pathlib import Path
from typing import Any

from igps._parallel import MachineError
from igps.cli.reading import Folder, chosen_dataset, limits_of, print_failures, signatures
from igps.data.pipeline import version
from igps.data.requirements import Requirements
from igps.descriptors import descriptor as descriptor_of
from igps.report.tables import write_rows

# Seconds until a scheduler that does not answer is taken for missing.
_ANSWERS_WITHIN = 15


def precompute(
    root: Path,
    descriptors: list[str] = ["pretrained"],  # noqa: B006 (only read)
    cluster: str | None = None,
    shard: str | None = None,
    failures: Path | None = None,
    strict: bool = False,
    n_workers: int | None = None,
    time_limit: float | None = None,
    memory_limit: float | None = None,
    **reading: Any,
) -> None:
    """Compute the signatures of a folder of meshes into the cache, here or on a cluster.

    What is there already is not computed again, so that a run that was stopped is finished by another.

    Args:
        descriptors: compute what these require.
        cluster: address of a Dask scheduler, such as tcp://scheduler:8786, whose workers see folder and cache by the
            same paths as this machine.
        shard: such as 3/64, the third of 64 parts of the meshes, for as many jobs of a batch system.
        failures: a CSV file for the meshes that cannot be used.
    """
    needs = reduce(or_, (descriptor_of(name).requirements for name in descriptors), Requirements())
    dataset = chosen_dataset(Folder(root), needs, **reading)
    dataset = dataset.subset(of_shard(len(dataset), shard))
    if not len(dataset):
        print(f"{root}: no mesh in shard {shard}")
        return
    limits = limits_of(time_limit, memory_limit)
    if cluster is None:
        failed = dataset.precompute(n_workers=n_workers, strict=strict, limits=limits)
    else:
        with dask_executor(cluster) as executor:
            failed = dataset.precompute(executor, strict=strict, limits=limits)
    if failures is not None:
        write_rows(failures, ("name", "error"), [(failure.id, failure.error) for failure in failed])
    part = "" if shard is None else f" in shard {shard}"
    print(f"{len(dataset) - len(failed)} of {len(dataset)} signatures{part} are in the cache; {len(failed)} failed")


def cache_export(root: Path, out: Path, descriptors: list[str] = ["pretrained"], **reading: Any) -> None:  # noqa: B006
    """Write the signatures of a folder to one file, which commands take in place of the folder.

    The file is read by memory map, runs no code, and holds no path: meshes that cannot be used are left out. Commands
    that look at the meshes themselves need the folder: doctor, duplicates, explain and outliers.

    Args:
        out: the file, its name ending in .igps.
        descriptors: compute what these require.
    """
    chosen = [descriptor_of(name) for name in descriptors]
    dataset, failures = signatures(Folder(root), chosen, **reading)
    out.parent.mkdir(parents=True, exist_ok=True)
    dataset.to_file(out)
    print(f"{len(dataset)} signatures written to {out}")
    print_failures(failures, len(dataset))


def of_shard(n_bodies: int, shard: str | None) -> range:
    """Which bodies a shard has, all if None: every n-th, so that the shards 1/n to n/n have all, each once."""
    if shard is None:
        return range(n_bodies)
    found = re.fullmatch(r"([1-9]\d*)/([1-9]\d*)", shard)
    if found is None or int(found[1]) > int(found[2]):
        raise ValueError(f"shard: expected a part such as 3/64, from 1/64 to 64/64, got {shard!r}.")
    return range(int(found[1]) - 1, n_bodies, int(found[2]))


@contextlib.contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """The workers of a Dask scheduler; a MachineError where none answers, or one has another version of the library."""
    try:
        from distributed import Client
    except ImportError as error:
        raise ImportError('cluster: needs Dask: pip install "interior-gps[cluster]".') from error
    # A lost scheduler is one sentence here; Dask would add tracebacks of its attempts to reconnect.
    for name in ("distributed", "distributed.client", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=_ANSWERS_WITHIN, set_as_default=False)
    except (OSError, ValueError) as error:  # a TimeoutError is an OSError
        raise MachineError(
            f"cluster: no Dask scheduler answers at {address}. Start one by `dask scheduler`, and workers by `dask "
            "worker` with its address."
        ) from error
    with client:
        for worker, theirs in client.run(version, on_error="return").items():
            if theirs != version():
                told = theirs if isinstance(theirs, str) else f"of another version ({type(theirs).__name__})"
                raise MachineError(
                    f"cluster: the worker at {worker} has igps {told}, where {version()} is asked for. Install one "
                    "version everywhere and run again."
                )
        yield client.get_executor()
