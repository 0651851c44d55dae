"""The benchmark: numbered classes and shapes, generated on demand or written to a folder."""

import json
import operator
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from igps._arrays import Floats, Integers
from igps._files import atomic_write
from igps._parameters import check_at_least
from igps._progress import Progress
from igps.shapes.meshing import defect, mesh, roughen
from igps.shapes.skeleton import pose
from igps.shapes.templates import TEMPLATES, Template

_VERSION = 1  # raise it whenever the same arguments give other meshes
_MAX_ATTEMPTS = 20
_POSE, _MOTION = 0, 1  # keys of random streams, which differ although their seed is the same


@dataclass(frozen=True, eq=False)
class GeneratedShape:
    """A generated mesh and its class."""

    vertices: Floats  # (V,3) float64, in units of about half the height of a figure
    faces: Integers  # (F,3) int64, outward
    label: str  # name of the class
    name: str  # class and running number, such as ``biped/00``
    genus: int  # number of handles of the surface; V − E + F = 2 − 2 genus
    rotation: Floats  # (3,3) from the upright frame to that of the mesh; ``vertices @ rotation`` is upright


class ArticulatedShapes:
    """A deterministic, labelled benchmark of closed manifold meshes of articulated bodies, class after class.

    A shape depends only on its class, its number in the class, ``seed`` and ``n_vertices``, but not on ``n_classes``.
    Shapes may therefore be generated in any order and by several processes.

    Example:
        >>> shapes = ArticulatedShapes(n_classes=3, n_per_class=2)
        >>> shapes.class_names, len(shapes)
        (['biped', 'quadruped', 'octopus'], 6)

    Args:
        n_classes: number of classes, the first of `templates`.
        n_per_class: number of shapes of each class.
        seed: seed of all random draws, not negative.
        n_vertices: number of vertices of a shape, within 40 percent.
        templates: what makes the skeleton of each class, by its name; eight animals and things by default.

    Raises:
        ValueError: an argument is out of range, or (on access) a shape cannot be made at this resolution.
    """

    def __init__(
        self,
        n_classes: int = 8,
        n_per_class: int = 10,
        seed: int = 0,
        n_vertices: int = 3000,
        templates: Mapping[str, Template] = TEMPLATES,
    ) -> None:
        check_at_least(1, n_classes=n_classes, n_per_class=n_per_class)
        check_at_least(0, seed=seed)
        check_at_least(500, n_vertices=n_vertices)
        if n_classes > len(templates):
            raise ValueError(f"n_classes must be at most {len(templates)}, got {n_classes}")
        self.templates = templates
        self.n_classes = n_classes
        self.n_per_class = n_per_class
        self.seed = seed
        self.n_vertices = n_vertices

    def __len__(self) -> int:
        return self.n_classes * self.n_per_class

    def __repr__(self) -> str:
        sizes = f"{self.n_classes}, {self.n_per_class}"
        return f"ArticulatedShapes({sizes}, seed={self.seed}, n_vertices={self.n_vertices})"

    @property
    def class_names(self) -> list[str]:
        """The unique names of the classes, in order."""
        return list(self.templates)[: self.n_classes]

    @property
    def labels(self) -> list[str]:
        """The class name of each shape."""
        return [name for name in self.class_names for _ in range(self.n_per_class)]

    @property
    def names(self) -> list[str]:
        """The unique name of each shape, ``class/number``."""
        return [
            f"{name}/{number:02d}"
            for name in self.class_names
            for number in range(self.n_per_class)
        ]

    def __getitem__(self, index: int) -> GeneratedShape:
        """Generate a shape, in a fraction of a second, without a cache; a ValueError if no pose gives a valid mesh."""
        position = operator.index(index)
        if not -len(self) <= position < len(self):
            raise IndexError(f"index must lie in [{-len(self)}, {len(self)}), got {index}")
        class_index, number = divmod(position % len(self), self.n_per_class)
        return self._generate(class_index, number)

    def _generate(self, class_index: int, number: int) -> GeneratedShape:
        label = list(self.templates)[class_index]
        skeleton = self.templates[label]()
        name = f"{label}/{number:02d}"
        motion = np.random.default_rng([self.seed, _MOTION, class_index, number])
        quaternion = motion.normal(size=4)
        rotation = np.asarray(Rotation.from_quat(quaternion).as_matrix())
        fault: str | None = None
        for attempt in range(_MAX_ATTEMPTS):
            rng = np.random.default_rng([self.seed, _POSE, class_index, number, attempt])
            target = int(self.n_vertices * rng.uniform(0.8, 1.25))
            # Later attempts bend less: most failures are limbs that touch.
            flex = 1.0 - 0.8 * attempt / _MAX_ATTEMPTS
            body = pose(skeleton, rng, flex, rotation)
            vertices, faces, spacing = mesh(body, target)
            amplitude = spacing * rng.uniform(0.0, 0.12)
            vertices = roughen(vertices, faces, amplitude, 10.0 * spacing, rng)
            fault = defect(vertices, faces, skeleton.genus, self.n_vertices)
            if fault is None:
                vertices += rng.uniform(-1.0, 1.0, 3)
                return GeneratedShape(vertices, faces, label, name, skeleton.genus, rotation)
        raise ValueError(
            f"n_vertices={self.n_vertices}: no valid mesh of {name} in {_MAX_ATTEMPTS} attempts, the last had {fault}. "
            "Raise n_vertices if parts are thin, or choose another seed for other poses."
        )

    def write(self, root: str | os.PathLike[str], progress: bool = False) -> None:
        """Write each shape to ``root/<class>/<number>.off``, unless the file exists.

        Files are written atomically, so that each is whole: the same call resumes an interrupted one, and several
        processes may write at once. ``root/shapes.json`` records the settings of the generator; classes and shapes may
        be added later.

        Raises:
            ValueError: ``root`` holds shapes of another seed, resolution or version.
        """
        folder = shapes_folder(
            root,
            generator="ArticulatedShapes",
            version=_VERSION,
            seed=self.seed,
            n_vertices=self.n_vertices,
        )
        names = Progress(self.names, desc="shapes", unit="shape", disable=not progress)
        for index, name in enumerate(names):
            path = folder / f"{name}.off"
            if not path.exists():
                shape = self[index]
                path.parent.mkdir(parents=True, exist_ok=True)
                with atomic_write(path) as file:
                    file.write(off_text(shape.vertices, shape.faces).encode())


def shapes_folder(root: str | os.PathLike[str], **settings: object) -> Path:
    """Return the folder of shapes with these settings, made if absent; a ValueError if it holds shapes of others."""
    folder = Path(root)
    expected = json.dumps(settings)
    manifest = folder / "shapes.json"
    if not manifest.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(manifest) as file:
            file.write(expected.encode())
        return folder
    recorded = manifest.read_text(encoding="utf-8")
    if recorded != expected:
        raise ValueError(
            f"root={str(root)!r} holds shapes of {recorded}, not of {expected}. Choose another folder."
        )
    return folder


def off_text(vertices: Floats, faces: Integers) -> str:
    """Return a mesh as text in the Object File Format; 17 digits preserve float64 values exactly."""
    lines = [f"OFF\n{len(vertices)} {len(faces)} 0"]
    lines += [f"{x:.17g} {y:.17g} {z:.17g}" for x, y, z in vertices.tolist()]
    lines += [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
    return "\n".join(lines) + "\n"
