"""Graded shapes: classes of bodies, bodies in poses."""

import contextlib
import logging
import operator
import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from igps._arrays import Floats, Integers
from igps._files import whole_file
from igps._parallel import Failed, run
from igps._parameters import check_at_least
from igps.mesh.mesh import Mesh, MeshError
from igps.shapes.benchmark import is_whole_off, off_text, shapes_folder
from training.graded.bodies import Body, Pose, draw_body, draw_pose
from training.graded.individuals import individual
from training.graded.kinds import LOOK_ALIKE_FAMILIES, LOOK_ALIKE_TEMPLATES, BodyClass, body_classes
from training.graded.scans import Scan

_VERSION = 2  # raised whenever the same arguments would give other meshes
_MAX_ATTEMPTS = 6
_KIN, _BODY, _POSE, _INDIVIDUAL = 10, 11, 12, 13  # what a random stream is for: keeps the streams of one seed apart
_SIBLINGS = 2  # bodies in a row with one skeleton, whose likeness makes bodies hard to tell apart

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class GradedShape:
    """One pose of one body of a class."""

    vertices: Floats  # (V,3) float64
    faces: Integers  # (F,3) int64, outward
    label: str  # name of the class
    body: str  # name of the body, ``class/00``
    name: str  # ``class/00/03``
    genus: int  # number of handles of the surface
    # (3,3) orthogonal, what turned, and perhaps mirrored, the shape out of its upright frame: ``vertices @ motion``
    # stands upright again
    motion: Floats
    notes: tuple[str, ...]  # what was done to the surface, in words


class GradedShapes:
    """A deterministic benchmark of levels: classes of bodies, perhaps individuals of each, and all in poses.

    A class is a kind of body; its bodies differ in proportions, thickness, details and whatever else the class leaves
    open, but every second is a sibling of the one before it, with the same skeleton in other proportions. The poses of
    a body bend one surface, nearly isometrically, as far as animals and tools bend. Things that do not bend are the
    same in every pose. Every pose has triangles of its own, and some are simplified, noisy, mirrored or made
    watertight.

    A shape depends on its class, body, individual, pose, ``seed``, ``n_vertices`` and ``look_alikes`` alone, so that
    shapes may be made in any order and by many processes, and more of them later.

    Args:
        n_classes: number of classes. The first twelve are named templates (`kinds.LOOK_ALIKE_TEMPLATES`).
        n_bodies: bodies of each class.
        n_poses: poses of each body.
        seed: seed of all random draws, not negative.
        n_vertices: the least and the greatest number of vertices, each kept within a third.
        look_alikes: with the templates, and the families, that resemble classes of SHREC'07 (see `kinds`);
            without, other classes take their places.
        n_individuals: of each body, nearly alike, each in ``n_poses`` poses (see `individuals`); 0 for the body itself.

    Raises:
        ValueError: an argument is out of range, or (on access) a shape cannot be made at this resolution.
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
            raise ValueError(f"n_vertices: expected two numbers, the first at least 1500 and no more than the second, "
                             f"got {n_vertices}.")  # fmt: skip
        self.n_classes, self.n_bodies, self.n_poses = n_classes, n_bodies, n_poses
        self.seed, self.n_vertices, self.look_alikes = seed, n_vertices, look_alikes
        self.n_individuals = n_individuals
        classes = body_classes(seed, look_alikes)
        if n_classes > len(classes):
            raise ValueError(f"n_classes: expected at most {len(classes)}, which are all there are, got {n_classes}.")
        self._classes: list[BodyClass] = classes[:n_classes]
        self._last: tuple[tuple[int, int], Body | ValueError] | None = None
        self._last_individual: tuple[tuple[int, int, int], Body] | None = None

    def __len__(self) -> int:
        return self.n_classes * self.n_bodies * max(self.n_individuals, 1) * self.n_poses

    def __repr__(self) -> str:
        return f"GradedShapes({', '.join(f'{name}={value!r}' for name, value in self.__getstate__().items())})"

    @property
    def class_names(self) -> list[str]:
        """The unique names of the classes, in order."""
        return [one.name for one in self._classes]

    @property
    def labels(self) -> list[str]:
        """The class of every shape."""
        return [name for name in self.class_names for _ in range(len(self) // self.n_classes)]

    @property
    def names(self) -> list[str]:
        """The unique name of every shape, ``class/body/pose``, or ``class/body/individual/pose``."""
        return [
            f"{name}/{body:02d}/{one}{pose:02d}"
            for name in self.class_names
            for body in range(self.n_bodies)
            for one in [f"{i:02d}/" for i in range(self.n_individuals)] or [""]
            for pose in range(self.n_poses)
        ]

    def __getitem__(self, index: int) -> GradedShape:
        """Make one shape; the body of the last one is kept for the next of its poses.

        Raises:
            IndexError: there is no such shape.
            ValueError: it cannot be made; names the shape and what went wrong.
        """
        body_class, number, one, pose = self._numbers(index)
        name = self.names[operator.index(index)]
        try:
            body = self._individual(body_class, number, one)
        except ValueError as error:
            raise self._impossible(name, str(error)) from error
        found = ""
        for attempt in range(_MAX_ATTEMPTS):
            rng = self._draws_of_pose(body_class, number, one, pose, attempt)
            scan = Scan.draw(rng, self.n_vertices)
            try:
                posed = draw_pose(body, rng, scan.target)
                mesh = scan.of(Mesh(posed.bent, posed.faces, name), rng)
            except (MeshError, ValueError) as error:
                found = str(error)
                _log.debug("%s: attempt %d: %s", name, attempt + 1, found)
                continue
            label = self._classes[body_class].name
            vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
            return GradedShape(vertices, faces, label, body_of(name), name, mesh.genus, scan.motion, mesh.notes)
        raise self._impossible(name, f"in {_MAX_ATTEMPTS} attempts, in the last {found}")

    def pose(self, index: int) -> Pose:
        """The surface of one shape at rest and bent, with the same triangles, before anything else happens to it.

        Of the first attempt at the shape, which is the shape's own unless that had to be made again.
        """
        body_class, number, one, pose = self._numbers(index)
        rng = self._draws_of_pose(body_class, number, one, pose, 0)
        scan = Scan.draw(rng, self.n_vertices)
        return draw_pose(self._individual(body_class, number, one), rng, scan.target)

    def write(self, root: str | os.PathLike[str], progress: bool = False, n_workers: int | None = 1) -> None:
        """Write every shape to ``root/<class>/<body>/<pose>.off``, leaving out what is there already.

        A folder that is read again (`igps.SignatureDataset`) has the classes as labels, and `body_of` tells the body of
        a file. Each file appears whole or not at all, so that an interrupted run is resumed by the same call.
        ``root/shapes.json`` records the settings; classes, bodies and poses may be added later.

        Args:
            root: folder, made where absent.
            progress: show a progress bar.
            n_workers: processes; all cores if None.

        Raises:
            ValueError: ``root`` holds other shapes, or a shape cannot be made; all others are written first.
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
        missing = [i for i, name in enumerate(names) if not is_whole_off(folder / f"{name}.off")]
        # A body at a time, so that it is drawn once for all its poses.
        jobs: dict[int, list[int]] = {}
        for i in missing:
            jobs.setdefault(i // (self.n_poses * max(self.n_individuals, 1)), []).append(i)
        failed = []
        with (
            tqdm(total=len(names), initial=len(names) - len(missing), desc="shapes", unit="shape",
                 disable=not progress) as bar,
            contextlib.closing(run(partial(_write, self, folder), list(jobs.values()), n_workers=n_workers)) as results,
        ):  # fmt: skip
            for number, outcome in results:
                bar.update(len(list(jobs.values())[number]))
                if isinstance(outcome, Failed):
                    failed.append(outcome.reason)
        if failed:
            raise ValueError(f"{len(failed)} of {len(jobs)} bodies were not written whole: {failed[0]}")

    def _draws_of_pose(self, body_class: int, number: int, one: int, pose: int, attempt: int) -> np.random.Generator:
        which = [_INDIVIDUAL, one] if self.n_individuals else []
        return np.random.default_rng([self.seed, _POSE, body_class, number, pose, attempt, *which])

    def _numbers(self, index: int) -> tuple[int, int, int, int]:
        position = operator.index(index)
        if not -len(self) <= position < len(self):
            raise IndexError(f"index: expected one in [{-len(self)}, {len(self)}), got {index}.")
        rest, pose = divmod(position % len(self), self.n_poses)
        rest, one = divmod(rest, max(self.n_individuals, 1))
        body_class, body = divmod(rest, self.n_bodies)
        return body_class, body, one, pose

    def _individual(self, body_class: int, number: int, one: int) -> Body:
        body = self._body(body_class, number)
        if not self.n_individuals:
            return body
        place = (body_class, number, one)
        if self._last_individual is None or self._last_individual[0] != place:
            drawn = individual(body, np.random.default_rng([self.seed, _INDIVIDUAL, *place]))
            self._last_individual = place, drawn
        return self._last_individual[1]

    def _body(self, body_class: int, number: int) -> Body:
        if self._last is None or self._last[0] != (body_class, number):
            kin = [self.seed, _KIN, body_class, number // _SIBLINGS]
            drawn: Body | ValueError
            try:
                drawn = draw_body(self._classes[body_class], kin, [self.seed, _BODY, body_class, number])
            except ValueError as error:  # kept as well: no other pose of it can be made either
                drawn = error
            self._last = (body_class, number), drawn
        if isinstance(self._last[1], ValueError):
            raise self._last[1]
        return self._last[1]

    def _impossible(self, name: str, reason: str) -> ValueError:
        return ValueError(
            f"n_vertices={self.n_vertices}: {name} could not be made: {reason} "
            "Thin parts need more vertices, another seed gives other bodies."
        )

    def __getstate__(self) -> dict[str, object]:
        return {name: getattr(self, name) for name in _ARGUMENTS}

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__init__(**state)  # type: ignore[misc]


_ARGUMENTS = ("n_classes", "n_bodies", "n_poses", "seed", "n_vertices", "look_alikes", "n_individuals")


def body_of(name: str) -> str:
    """The body of a shape by its name or its file's, ``class/body/pose`` or ``class/body/individual/pose``."""
    return "/".join(name.split("/")[:2])


def individual_of(name: str) -> str:
    """The individual of a shape by its name or its file's; the body where there are no individuals."""
    return name.rsplit("/", 1)[0]


def family_of(label: str) -> str:
    """The family of a class by its name: the kind of its bodies, or the template itself."""
    return label.split("-")[0]


def looks_alike(label: str) -> bool:
    """Whether a class, by its name, resembles one of SHREC'07 (see `training.graded.kinds`)."""
    return label in LOOK_ALIKE_TEMPLATES or family_of(label) in LOOK_ALIKE_FAMILIES


def _write(shapes: GradedShapes, folder: Path, indices: list[int]) -> None:
    """Write some of the shapes; all of them are tried, and the first that fails is told."""
    failed: ValueError | None = None
    for index in indices:
        try:
            shape = shapes[index]
        except ValueError as error:
            failed = failed or error
            continue
        path = folder / f"{shape.name}.off"
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path) as file:
            file.write(off_text(shape.vertices, shape.faces).encode())
    if failed is not None:
        raise failed
