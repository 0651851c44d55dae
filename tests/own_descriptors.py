"""Simple descriptors with known distances, some of which fail on purpose."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from torch import Tensor

import igps
from igps.data.batch import Body
from igps.data.requirements import Requirements
from igps.descriptors.gps import gps
from igps.descriptors.interior import interior

CONFIG = igps.SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=60)
SMALL = [
    "--signature.n_eigenpairs",
    "20",
    "--signature.resolution",
    "10",
    "--signature.min_samples",
    "0",
]
SMALL += ["--signature.n_surface_samples", "60", "--n_workers", "1"]
"""The options of the same."""


def changed(descriptor, **numbers):
    """Return a descriptor with other numbers than the published ones."""
    for name, number in numbers.items():
        assert hasattr(descriptor, name)
        setattr(descriptor, name, number)
    return descriptor


class Height(igps.BodyDescriptor):
    """Describes a mesh by its height, and fails in the given way on the mesh named `bad`."""

    source = "nobody"
    invariant_to = ("motion",)
    requirements = Requirements(mesh=True)

    def __init__(
        self, name: str = "height", bad: str = "no such mesh", fault: str = "raise"
    ) -> None:
        super().__init__()
        self.name = name
        self.bad = bad
        self.fault = fault

    def describe_body(self, body: Body) -> NDArray[np.float32]:
        height = np.ptp(body.mesh.vertices[:, 2])
        if body.id.endswith(self.bad):
            if self.fault == "raise":
                raise ValueError(f"a height of {height:.1f} is too much")
            if self.fault == "kill":
                os._exit(1)
            if self.fault == "shape":
                return np.zeros(3, dtype=np.float32)
            return np.array([np.nan], dtype=np.float32)
        return np.array([height], dtype=np.float32)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        return (queries - gallery[:, 0]).abs()


class Broken(Height):
    """Cannot compare."""

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        raise RuntimeError("out of order")


class Slow(Height):
    """Sleeps, works and reads the mesh: only the work is processor time."""

    def describe_body(self, body: Body) -> NDArray[np.float32]:
        time.sleep(0.3)
        end = time.process_time() + 0.05
        while time.process_time() < end:
            pass
        return super().describe_body(body)


class Root(igps.BodyDescriptor):
    """Sees the square root of the area, and refuses surfaces with a hole."""

    name = "root"
    source = "nobody"
    invariant_to = ("motion",)
    requirements = Requirements(mesh=True)

    def describe_body(self, body: Body) -> NDArray[np.float32]:
        if body.mesh.allow_open:
            raise ValueError("a hole has no area")
        assert body.mesh.area == pytest.approx(body.area)
        return np.array([np.sqrt(body.mesh.area)], dtype=np.float32)

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        return (queries - gallery.T).abs()


class Same(igps.BodyDescriptor):
    """Sees no difference at all."""

    name = "same"
    source = "nobody"

    def describe_body(self, body: Body) -> NDArray[np.float32]:
        return np.full(
            1,
            np.nan if body.id.endswith("nan.off") else 0,
            dtype=np.float32,
        )

    def distances(self, queries: Tensor, gallery: Tensor) -> Tensor:
        return 0 * (queries - gallery.T)


def picky() -> Height:
    """One that cannot describe a mesh."""
    return Height("picky", bad="egg/1.off")


def broken() -> Height:
    """One without distances."""
    return Broken("broken")


def write_egg(path: Path, height: float, subdivisions: int = 3) -> Path:
    """An egg whose area differs with its height, in a file."""
    body = trimesh.creation.icosphere(subdivisions=subdivisions)
    body.vertices *= [1, 1, height]
    path.parent.mkdir(parents=True, exist_ok=True)
    body.export(path)
    return path


def root_area(path: Path) -> float:
    """The square root of the area of the mesh in a file."""
    return float(np.sqrt(trimesh.load(path, process=False).area))


def small_interior() -> igps.Descriptor:
    """The paper's descriptor with the eigenpairs that small meshes have."""
    return interior(n_eigenpairs=20)


def small_gps() -> igps.Descriptor:
    """The same on the surface."""
    return gps(n_eigenpairs=20)
