"""Bodies of objects in memory."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from igps.data.sources import Bodies
from igps.mesh.errors import MeshError
from igps.mesh.loading import BodyRef, surface_body
from igps.mesh.mesh import Mesh
from igps.mesh.objects import object_bodies
from igps.mesh.options import LoadOptions


def bodies_in_memory(
    objects: Mapping[str, Any],
    labels: Sequence[str] | None,
    options: LoadOptions,
) -> tuple[Bodies, dict[BodyRef, Mesh | MeshError]]:
    """Return the bodies of objects by name, see `object_bodies`, and the mesh or the error of each body."""
    if labels is not None and len(labels) != len(objects):
        raise ValueError(
            f"labels: expected one for each of {len(objects)} bodies, got {len(labels)}."
        )
    if not objects:
        raise ValueError("bodies: expected at least one, got none.")
    meshes: dict[BodyRef, Mesh | MeshError] = {}
    classes: list[str] = []
    for i, (name, value) in enumerate(objects.items()):
        n_before = len(meshes)
        try:
            for raw in object_bodies(value, name, options):
                ref = BodyRef(Path(name), raw.part)
                try:
                    meshes[ref] = surface_body(raw.made(), ref, options)
                except MeshError as error:
                    meshes[ref] = error
        except MeshError as error:
            meshes[BodyRef(Path(name))] = error
        classes += [] if labels is None else [labels[i]] * (len(meshes) - n_before)
    names = tuple(map(str, meshes))
    return Bodies(tuple(meshes), names, None if labels is None else tuple(classes)), meshes
