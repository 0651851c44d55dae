"""The benchmark of graded shapes: classes, bodies of a class, individuals of a body, and poses."""

import contextlib
import itertools
import logging
import operator
import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from igps._arrays import Floats, Integers
from igps._files import atomic_write
from igps._parallel import run
from igps._parameters import check_at_least
from igps.failures import Failed
from igps.mesh.errors import MeshError
from igps.mesh.mesh import Mesh
from igps.shapes.benchmark import off_text, shapes_folder
from training.shapes.bodies import Body, Pose, draw_body, draw_pose
from training.shapes.individuals import individual
from training.shapes.kinds import LOOK_ALIKE_FAMILIES, LOOK_ALIKE_TEMPLATES, BodyClass, body_classes
from training.shapes.scans import Scan

_VERSION = 2  # raised when the same arguments give other meshes
_MAX_ATTEMPTS = 6
# Parts of seeds that make random streams independent.
_KIN, _BODY, _POSE, _INDIVIDUAL = range(10, 14)
_N_SIBLINGS = 2  # successive bodies with the same skeleton, which are hard to tell apart

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class GradedShape:
    """A pose of a body."""

    vertices: Floats  # (V,3) float64
    faces: Integers  # (F,3) int64, outward
    label: str  # name of the class
    body: str  # name of the body, such as `class/00`
    name: str  # name of the shape, such as `class/00/03`
    genus: int  # number of handles of the surface
    motion: Floats  # (3,3) orthogonal, rotation and reflection of the shape; `vertices @ motion` is upright
    notes: tuple[str, ...]  # descriptions of the changes of the surface


class GradedShapes:
    """A deterministic benchmark with several levels: classes, bodies, optionally individuals, and poses.

    The bodies of a class differ in proportions, thickness, details and other choices that the class leaves open. Every
    second body has the same skeleton as the body before it, in other proportions. The poses of a body bend the same
    surface nearly isometrically, as far as animals and tools bend. Rigid bodies have the same shape in every pose.
    Each pose has another triangulation, and some are simplified, noisy, mirrored or made watertight.

    A shape depends only on its class, body, individual, pose, `seed`, `n_vertices` and `look_alikes`. Shapes can
    therefore be made in any order and in parallel, and shapes can be added later.

    Args:
        n_classes: number of classes. The first twelve are named templates (`kinds.LOOK_ALIKE_TEMPLATES`).
        n_bodies: number of bodies of each class.
        n_poses: number of poses of each body.
        seed: seed of all random draws, not negative.
        n_vertices: smallest and largest number of vertices, with a tolerance of a third.
        look_alikes: whether to include the templates and families that resemble classes of SHREC'07 (see `kinds`);
            if not, other classes take their places.
        n_individuals: number of similar individuals of each body, each in `n_poses` poses (see `individuals`); 0 for
            the body itself.

    Raises:
        ValueError: an argument is out of range; or, on access, a shape cannot be made at this resolution.
    """

    def __init__(
        self,
        n_classes: int = 24,
        n_bodies: int = 3,
        n_poses: int = 5,
        seed: int = 0,
        *,
        n_vertices: tuple[int, int] = (2400, 5000),
        look_alikes: bool = True,
        n_individuals: int = 0,
    ) -> None:
        check_at_least(1, n_classes=n_classes, n_bodies=n_bodies, n_poses=n_poses)
        check_at_least(0, seed=seed, n_individuals=n_individuals)
        if not 1500 <= n_vertices[0] <= n_vertices[1]:
            raise ValueError(
                f"n_vertices: expected two numbers, the first at least 1500 and no more than the second, "
                f"got {n_vertices}."
            )
        self.n_classes = n_classes
        self.n_bodies = n_bodies
        self.n_poses = n_poses
        self.seed = seed
        self.n_vertices = n_vertices
        self.look_alikes = look_alikes
        self.n_individuals = n_individuals
        classes = body_classes(seed, look_alikes)
        if n_classes > len(classes):
            raise ValueError(
                f"n_classes: expected at most {len(classes)}, the number of all classes, got {n_classes}."
            )
        self._classes: list[BodyClass] = classes[:n_classes]
        self._last: tuple[tuple[int, int], Body | ValueError] | None = None
        self._last_individual: tuple[tuple[int, int, int], Body] | None = None

    def __len__(self) -> int:
        return self.n_classes * self.n_bodies * max(self.n_individuals, 1) * self.n_poses

    def __repr__(self) -> str:
        arguments = [f"{name}={value!r}" for name, value in self.__getstate__().items()]
        return f"GradedShapes({', '.join(arguments)})"

    @property
    def class_names(self) -> list[str]:
        """The unique names of the classes, in order."""
        return [body_class.name for body_class in self._classes]

    @property
    def labels(self) -> list[str]:
        """The class of every shape."""
        n_each = len(self) // self.n_classes
        return [name for name in self.class_names for _ in range(n_each)]

    @property
    def names(self) -> list[str]:
        """The unique name of every shape, `class/body/pose` or `class/body/individual/pose`."""
        individuals = [f"{i:02d}/" for i in range(self.n_individuals)] or [""]
        return [
            f"{name}/{body:02d}/{individual_prefix}{pose:02d}"
            for name in self.class_names
            for body in range(self.n_bodies)
            for individual_prefix in individuals
            for pose in range(self.n_poses)
        ]

    def __getitem__(self, index: int) -> GradedShape:
        """Make a shape; its body is kept for further poses.

        Raises:
            IndexError: there is no such shape.
            ValueError: the shape cannot be made.
        """
        body_class, number, individual_number, pose = self._numbers(index)
        name = self.names[operator.index(index)]
        try:
            body = self._individual(body_class, number, individual_number)
        except ValueError as error:
            raise self._failure(name, str(error)) from error
        reason = ""
        for attempt in range(_MAX_ATTEMPTS):
            rng = self._pose_generator(body_class, number, individual_number, pose, attempt)
            scan = Scan.draw(rng, self.n_vertices)
            try:
                posed = draw_pose(body, rng, scan.target)
                mesh = scan.of(Mesh(posed.bent, posed.faces, name), rng)
            except (MeshError, ValueError) as error:
                reason = str(error)
                _log.debug("%s: attempt %d: %s", name, attempt + 1, reason)
                continue
            label = self._classes[body_class].name
            vertices = np.array(mesh.vertices)
            faces = np.array(mesh.faces)
            return GradedShape(
                vertices, faces, label, body_of(name), name, mesh.genus, scan.motion, mesh.notes
            )
        raise self._failure(name, f"{_MAX_ATTEMPTS} attempts failed, the last with: {reason}")

    def pose(self, index: int) -> Pose:
        """Return the surface of a shape at rest and in its pose, with the same triangles, before the changes of `Scan`.

        The pose is that of the first attempt, which is the pose of the shape unless this attempt failed.
        """
        body_class, number, individual_number, pose = self._numbers(index)
        body = self._individual(body_class, number, individual_number)
        rng = self._pose_generator(body_class, number, individual_number, pose, 0)
        scan = Scan.draw(rng, self.n_vertices)
        return draw_pose(body, rng, scan.target)

    def write(
        self, root: str | os.PathLike[str], progress: bool = False, n_workers: int | None = 1
    ) -> None:
        """Write every shape to `root/<class>/<body>/<pose>.off`, except shapes that are already there.

        If `igps.SignatureDataset` reads the folder, the labels are the classes, and `body_of` returns the body of a
        file. Files are written atomically, and the same call resumes an interrupted run. The settings are saved in
        `root/shapes.json`. Classes, bodies and poses can be added later.

        Args:
            root: folder, created if it does not exist.
            progress: show a progress bar.
            n_workers: number of processes; all cores if None.

        Raises:
            ValueError: the folder holds other shapes, or a shape cannot be made; all others are written first.
        """
        folder = shapes_folder(
            root,
            generator=type(self).__name__,
            version=_VERSION,
            seed=self.seed,
            n_vertices=list(self.n_vertices),
            look_alikes=self.look_alikes,
            **({"individuals": True} if self.n_individuals else {}),
        )
        names = self.names
        missing = [i for i, name in enumerate(names) if not (folder / f"{name}.off").exists()]
        # A job has all missing poses of a body, so that the body is drawn once.
        n_each = self.n_poses * max(self.n_individuals, 1)
        jobs = [list(of_body) for _, of_body in itertools.groupby(missing, lambda i: i // n_each)]
        failed = []
        bar = tqdm(
            total=len(names),
            initial=len(names) - len(missing),
            desc="shapes",
            unit="shape",
            disable=not progress,
        )
        outcomes = run(partial(_write, self, folder), jobs, n_workers=n_workers)
        with bar, contextlib.closing(outcomes):
            for number, outcome in outcomes:
                bar.update(len(jobs[number]))
                if isinstance(outcome, Failed):
                    failed.append(outcome.reason)
        if failed:
            raise ValueError(f"{len(failed)} of {len(jobs)} bodies are incomplete: {failed[0]}")

    def _pose_generator(
        self, body_class: int, number: int, individual_number: int, pose: int, attempt: int
    ) -> np.random.Generator:
        suffix = [_INDIVIDUAL, individual_number] if self.n_individuals else []
        return np.random.default_rng([self.seed, _POSE, body_class, number, pose, attempt, *suffix])

    def _numbers(self, index: int) -> tuple[int, int, int, int]:
        """The numbers of the class, body, individual and pose of a shape."""
        position = operator.index(index)
        if not -len(self) <= position < len(self):
            raise IndexError(
                f"index: expected an index in [{-len(self)}, {len(self)}), got {index}."
            )
        remainder, pose = divmod(position % len(self), self.n_poses)
        remainder, individual_number = divmod(remainder, max(self.n_individuals, 1))
        body_class, body = divmod(remainder, self.n_bodies)
        return body_class, body, individual_number, pose

    def _individual(self, body_class: int, number: int, individual_number: int) -> Body:
        body = self._body(body_class, number)
        if not self.n_individuals:
            return body
        key = (body_class, number, individual_number)
        if self._last_individual is None or self._last_individual[0] != key:
            rng = np.random.default_rng([self.seed, _INDIVIDUAL, *key])
            self._last_individual = key, individual(body, rng)
        return self._last_individual[1]

    def _body(self, body_class: int, number: int) -> Body:
        if self._last is None or self._last[0] != (body_class, number):
            kin = [self.seed, _KIN, body_class, number // _N_SIBLINGS]
            seed = [self.seed, _BODY, body_class, number]
            drawn: Body | ValueError
            try:
                drawn = draw_body(self._classes[body_class], kin, seed)
            except ValueError as error:  # kept, as no other pose of the body can be made either
                drawn = error
            self._last = (body_class, number), drawn
        _, body = self._last
        if isinstance(body, ValueError):
            raise body
        return body

    def _failure(self, name: str, reason: str) -> ValueError:
        return ValueError(
            f"n_vertices={self.n_vertices}: {name} could not be made: {reason.removesuffix('.')}. "
            "Raise n_vertices, because thin parts need more vertices, or take another seed."
        )

    def __getstate__(self) -> dict[str, object]:
        return {name: getattr(self, name) for name in _ARGUMENTS}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__init__(**state)  # type: ignore[misc]


_ARGUMENTS = (
    "n_classes",
    "n_bodies",
    "n_poses",
    "seed",
    "n_vertices",
    "look_alikes",
    "n_individuals",
)


def body_of(name: str) -> str:
    """Return the body of a shape by the name of the shape or its file, see `GradedShapes.names`."""
    return "/".join(name.split("/")[:2])


def individual_of(name: str) -> str:
    """Return the individual of a shape by the name of the shape or its file; its body if there are no individuals."""
    return name.rsplit("/", 1)[0]


def family_of(label: str) -> str:
    """Return the family of a class by its name: its kind, or its template."""
    return label.split("-")[0]


def looks_alike(label: str) -> bool:
    """Return whether a class, given by its name, resembles a class of SHREC'07 (see `training.shapes.kinds`)."""
    return label in LOOK_ALIKE_TEMPLATES or family_of(label) in LOOK_ALIKE_FAMILIES


def _write(shapes: GradedShapes, folder: Path, indices: list[int]) -> None:
    """Write the shapes of some indices; after trying all, raise the error of the first that failed."""
    failed: ValueError | None = None
    for index in indices:
        try:
            shape = shapes[index]
        except ValueError as error:
            failed = failed or error
            continue
        path = folder / f"{shape.name}.off"
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as file:
            file.write(off_text(shape.vertices, shape.faces).encode())
    if failed is not None:
        raise failed
