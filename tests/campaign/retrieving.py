"""`igps retrieve` on a few small shapes, as a process that can be killed, and its results."""

from __future__ import annotations

import csv
import json
import os
import sys
import types
from pathlib import Path

import numpy as np
import torch
import trimesh

from igps.shapes.benchmark import off_text

HERE = Path(__file__).parent
SHAPES_PER_CLASS = 4


def write_shapes(folder):
    """Write three classes of four closed surfaces of about two hundred vertices, a folder for each class."""
    meshes = {
        "ball": trimesh.creation.icosphere(subdivisions=2),
        "ring": trimesh.creation.torus(1.0, 0.35, major_sections=20, minor_sections=10),
        "rod": trimesh.creation.capsule(height=2.0, radius=0.5, count=[14, 14]),
    }
    generator = np.random.default_rng(0)
    for label, mesh in meshes.items():
        (folder / label).mkdir(parents=True)
        for number in range(SHAPES_PER_CLASS):
            x, y, z = np.asarray(mesh.vertices).T
            a, b, c = generator.uniform(0.05, 0.3, 3)
            vertices = np.stack(
                [x * (1 + a), y + b * x * x, z + c * np.sin(2 * x)],
                axis=1,
            )
            (folder / label / f"{number}.off").write_text(
                off_text(vertices, np.asarray(mesh.faces))
            )


def arguments(shapes, cache, out, n_workers):
    """Arguments of the command, without its name."""
    signature = {"n_eigenpairs": 6, "resolution": 10, "min_samples": 0, "n_surface_samples": 20}
    words = ["retrieve", str(shapes), "--descriptor", "cheap_descriptor:cheap"]
    words += ["--n_workers", str(n_workers), "--cache_dir", str(cache), "--out", str(out)]
    words += [f"--signature.{name}={value}" for name, value in signature.items()]
    return words


class Command:
    """The command in a fork of this process, which starts at once, because all modules are imported already."""

    def __init__(self, shapes, cache, out, n_workers):
        out.parent.mkdir(parents=True, exist_ok=True)
        self.log = out.with_suffix(".log")
        words = ["igps", *arguments(shapes, cache, out, n_workers)]
        sys.stdout.flush()
        sys.stderr.flush()
        self.pid = os.fork()
        if self.pid == 0:
            _become(words, self.log)
        self._status: int | None = None

    def children(self):
        """Return the process ids of the command's workers."""
        return children(self.pid)

    def status(self):
        """Return the exit status, minus the signal that ended the command, or None while it runs."""
        if self._status is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self._status = os.waitstatus_to_exitcode(status) if pid else None
        return self._status

    def wait(self):
        """Wait for the end of the command and return its exit status."""
        if self._status is None:
            self._status = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self._status


def _become(words, log):
    status = 70
    try:
        os.setsid()
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        for stream in (1, 2):
            os.dup2(handle, stream)
        sys.argv = words
        # Workers import the main module. Without this line, it would be a module of the campaign.
        sys.modules["__main__"] = types.ModuleType("__main__")
        os.environ["PYTHONPATH"] = os.pathsep.join([str(HERE), *filter(None, sys.path)])
        sys.path.insert(0, str(HERE))
        torch.set_num_threads(1)
        main = _command()
        main()
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _command():
    from igps.cli import main

    return main


def children(pid):
    """Return the ids of the child processes of a process."""
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def is_python_worker(pid):
    """Return whether a process is a worker, and not the resource tracker of multiprocessing."""
    try:
        return b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


def table(out):
    """Return the complete results of a run, bit by bit; None if they are incomplete."""
    try:
        scores = json.loads((out / "scores.json").read_text())
        with (out / "ranking.csv").open(newline="") as file:
            ranking = list(csv.reader(file))
        with np.load(out / "distances.npz") as archive:
            arrays = {
                name: (archive[name].dtype.str, archive[name].tobytes()) for name in archive.files
            }
    except (OSError, ValueError, KeyError, EOFError):
        return None
    return {
        "scores": scores,
        "ranking": ranking,
        "arrays": arrays,
        "failures": (out / "failures.csv").exists(),
    }


def partials(cache):
    """Return partially written files of a cache, without the database of known files, which repairs itself."""
    others = [path for path in cache.rglob("*") if path.is_file() and path.suffix != ".safetensors"]
    return [path for path in others if not path.name.startswith("known_files.sqlite")]
