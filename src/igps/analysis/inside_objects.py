"""Where inside bodies an image lies, for images and labels in memory."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from igps._arrays import Floats
from igps.analysis.inside import column_names, inside_numbers
from igps.analysis.inside_collection import inside_config
from igps.data.attribute_sources import fill_missing
from igps.data.grids import Grid, grid_of
from igps.data.in_memory import bodies_in_memory
from igps.mesh.errors import MeshError
from igps.mesh.loading import refined
from igps.mesh.mesh import Mesh
from igps.mesh.options import LoadOptions
from igps.signature.signature import SignatureConfig, compute_signature

_RIGHT_ANGLES = 1e-3  # largest cosine between the axes of a grid of labels


def inside(image: Any, label: Any, spacing: Sequence[float] | None = None) -> list[dict[str, Any]]:
    """Tell where in each labelled body the values of an image lie, in numbers that do not depend on pose.

    The page *Where inside: the numbers* defines each. `pandas.DataFrame(inside(image, label))` is a table.

    Example:
        >>> import numpy as np
        >>> x, y, z = np.indices((20, 20, 20)) - 9.5
        >>> radius = np.sqrt(x**2 + y**2 + z**2)
        >>> rows = inside(radius, radius < 8, spacing=(1, 1, 1))
        >>> [row["label"] for row in rows], bool(rows[0]["image.rim.contrast"] > 1)
        (['1'], True)

    Args:
        image: an image, see `grid_of`, or several by name, such as `{"ct": ct, "pet": pet}`; the name is otherwise
            "image". Or a `torchio.Subject`: all its intensity images are used, and the rest of it joins each row.
        label: labels of voxels in one of the same forms, 0 outside; of a `torchio.Subject`, the name of its label map.
            Image and labels may have different grids, if they have a place in the world.
        spacing: sides of a voxel, if image and label are arrays.

    Returns:
        A row for each label: `label`, `volume` and `area` in powers of the unit of length, the numbers by name (NaN
        where they are not defined), and `note`, a sentence if the body has no numbers.

    Raises:
        MeshError: no body could be used.
        TypeError: not an image.
        ValueError: an image has several channels, or image and labels do not match.
    """
    metadata: dict[str, Any] = {}
    if hasattr(image, "get_images_dict"):  # a torchio.Subject
        everything = image.get_images_dict(intensity_only=False)
        metadata = {name: value for name, value in image.items() if name not in everything}
        label = everything[label]
        image = image.get_images_dict(intensity_only=True)
    named = image if isinstance(image, Mapping) else {"image": image}
    images = {name: grid_of(one, spacing) for name, one in named.items()}
    labels = grid_of(label, spacing)
    _check_same_place(images, labels)
    config = inside_config(SignatureConfig())
    volume = (labels.values, tuple(_sides_of_voxel(labels).tolist()))
    bodies, meshes = bodies_in_memory({"label": volume}, None, LoadOptions())
    rows: list[dict[str, Any]] = []
    errors: list[MeshError] = []
    for part, mesh in zip(bodies.parts, meshes.values(), strict=True):
        row = {**metadata, "label": part or "1"}
        try:
            row |= _numbers(mesh, images, labels, config)
        except MeshError as error:
            errors.append(error)
            row |= dict.fromkeys(["volume", "area", *column_names(list(images))], np.nan)
            row["note"] = str(error)
        rows.append(row)
    if len(errors) == len(rows):
        raise errors[0]
    return rows


def _sides_of_voxel(labels: Grid) -> Floats:
    """Return the sides (3,) of a voxel; raise a ValueError unless the axes of the grid have right angles."""
    axes = labels.affine[:3, :3]
    sides = np.linalg.norm(axes, axis=0)
    directions = axes / sides
    cosines = directions.T @ directions - np.eye(3)
    if not np.abs(cosines).max() < _RIGHT_ANGLES:  # also if NaN
        raise ValueError(
            "label: expected voxels with right angles. Resample the labels to a grid without shear."
        )
    return sides


def _check_same_place(images: Mapping[str, Grid], labels: Grid) -> None:
    """Raise a ValueError if arrays without a place in the world have different shapes."""
    for name, grid in images.items():
        has_same_affine = np.array_equal(grid.affine, labels.affine)
        if has_same_affine and grid.values.shape != labels.values.shape:
            raise ValueError(
                f"{name}: expected the shape of the labels, {labels.values.shape}, got {grid.values.shape}. "
                "Give both of the same subject, or images that know their place."
            )


def _numbers(
    mesh: Mesh | MeshError, images: Mapping[str, Grid], labels: Grid, config: SignatureConfig
) -> dict[str, Any]:
    """Return the numbers of a body, whose mesh lies along the axes of the labels, from the first voxel."""
    if isinstance(mesh, MeshError):
        raise mesh
    finer = refined(mesh, LoadOptions(), config.n_vertices_read)
    signature = compute_signature(finer, config)
    places = labels.to_world(signature.interior.points / _sides_of_voxel(labels))
    values = {}
    for name, grid in images.items():
        values[name] = fill_missing(grid.at(places), places, f"{mesh.name}: {name}")
    samples = signature.interior.with_attributes(values)
    numbers = inside_numbers(replace(signature, interior=samples), list(images))
    return {"volume": signature.volume, "area": signature.area, **numbers, "note": ""}
