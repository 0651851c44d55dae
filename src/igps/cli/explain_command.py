"""The command `igps explain`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igps._parameters import check_fraction
from igps._text import counted

if TYPE_CHECKING:
    from igps.analysis.explanation import Explanation, Shares
    from igps.analysis.superposition import Movement
    from igps.cli.reading import Described, Folder
    from igps.data.dataset import SignatureDataset
    from igps.data.sources import Bodies
    from igps.report.figures import Painted


CALIBRATED = "pretrained"
"""The only descriptor whose distances are calibrated, see `igps.duplicates.calibration`."""

_LEGEND = "share of the distance, over that of an even spread"


def explain(
    meshes: list[Path],
    descriptor: str = "pretrained",
    group: str | None = None,
    body: str | None = None,
    axis: int | None = None,
    level: float = 0.05,
    out: Path | None = None,
    **describing: Any,
) -> dict[str, Any]:
    """Show where two bodies or two groups of bodies differ, by the share of each part in their distance.

    Args:
        meshes: two files; or a folder with two groups, or, with --axis, without groups.
        descriptor: a descriptor made of histograms, such as interior, rich or pretrained.
        group: column of labels.csv that holds the groups of a folder; the class if not given.
        body: of a folder, only the bodies of this name in their files, such as an organ.
        axis: of a folder, the two bodies at the ends of axis 1 or 2 of its map, see igps clusters, between which its
            bodies vary most; without groups.
        level: family-wise error rate, for two groups: the places where they do not differ significantly are pale.
        out: folder for explain.csv (shares of the histograms), explain_samples.csv (shares of the samples), and
            explain.svg and explain.png: two bodies painted with their shares, or the mean difference of two groups;
            the same for viewers as explain_BODY.ply, .vtk, .gii and .nii.gz; of each attribute of --with also
            explain_ATTRIBUTE.csv and slices, and explain_BODY_ATTRIBUTE for viewers;
            of two molecules of one sequence also explain_residues.csv, and both superposed as explain_1.cif and
            explain_2.cif with the shares of residues in percent in place of B-factors.
    """
    from igps.analysis.dissimilarity import REQUIREMENTS
    from igps.analysis.explanation import without_head
    from igps.cli.reading import Folder, described, files_or_folder
    from igps.descriptors import descriptor as descriptor_of
    from igps.descriptors.with_attributes import split_attributes

    check_fraction(level=level)
    source = files_or_folder(meshes)
    if isinstance(source, Folder):
        _check_folder(group, axis)
    else:
        _check_files(source, group, body, axis)
    # Raises for other descriptors before anything is computed
    without_head(split_attributes(descriptor_of(descriptor))[0])
    if not isinstance(source, Folder):
        result = described(source, descriptor, **{**describing, "strict": True}, also=REQUIREMENTS)
        found = _explain_pair(result, _only_pair(result.dataset), descriptor)
    elif axis is not None:
        folder = Folder(source.root, body=body)
        result = described(folder, descriptor, **describing, also=REQUIREMENTS)
        _print_kinds(result.dataset, body)
        found = _explain_pair(result, _ends_of_axis(result, axis), descriptor)
    else:
        check = partial(_two_groups, group=group)
        folder = Folder(source.root, group is None, check=check, body=body)
        found = _explain_groups(folder, descriptor, level, **describing)
    explanation = found.explanation
    names = [found.dataset.bodies.names[i] for i in found.pair]
    of_names = " and ".join(names)
    print(f"{of_names}: {explanation.distance:.4g} by {found.descriptor}: {explanation.summary()}")
    for line in found.lines:
        print(line)
    for name, told in found.attributes.items():
        print(f"{name}: {told.distance:.4g} more, by where its values lie inside")
    if out is not None:
        _write(out, found, names)
        print(f"written to {out}")
    return {
        "bodies": names,
        "distance": explanation.distance,
        "meaning": found.meaning,
        "shares": _part_rows(explanation),
        "attributes": {name: told.distance for name, told in found.attributes.items()},
    }


def _check_folder(group: str | None, axis: int | None) -> None:
    if axis not in (None, 1, 2):
        raise ValueError(f"axis: expected 1 or 2, got {axis}.")
    if axis is not None and group is not None:
        raise ValueError("axis, group: expected one of them. Leave the other out.")


def _check_files(files: Sequence[Path], *of_folders: object) -> None:
    from igps.cli.reading import check_files

    if len(files) != 2:
        raise ValueError(
            f"meshes: expected two files, or a folder of two groups, got {counted(len(files), 'file')}."
        )
    if any(option is not None for option in of_folders):
        raise ValueError(
            "group, body, axis: expected a folder with them, got files. Leave them out."
        )
    check_files(files)


def _two_groups(bodies: Bodies, group: str | None) -> Any:
    """Return the group of each body (N,) as an array; raise a ValueError unless there are two groups."""
    import numpy as np

    labels = np.array((bodies.labels or ()) if group is None else bodies.column(group))
    names = sorted(set(labels.tolist()))
    if len(names) != 2:
        listed = ", ".join(names[:5])
        raise ValueError(f"meshes: expected a folder of two groups, got {len(names)}: {listed}.")
    return labels


def _only_pair(dataset: SignatureDataset) -> list[int]:
    names = dataset.bodies.names
    if len(names) != 2:
        listed = ", ".join(names[:4])
        raise ValueError(
            f"meshes: expected two bodies, got {len(names)}: {listed}. Name each as FILE#PART."
        )
    return [0, 1]


def _ends_of_axis(result: Described, axis: int) -> list[int]:
    """Return the two bodies at the ends of an axis of the map."""
    from igps.analysis.comparison import pair_distances
    from igps.analysis.map import ends_of_axis

    distances = pair_distances(result.descriptor, result.descriptions, progress=True)
    ends, share = ends_of_axis(distances.double().numpy(), axis)
    n = len(result.dataset)
    print(
        f"axis {axis} of the map has {share:.0%} of the squared distances of {n} bodies; its ends:"
    )
    return list(ends)


def _print_kinds(dataset: SignatureDataset, body: str | None) -> None:
    n_kinds = len(set(dataset.bodies.parts))
    if body is None and n_kinds > 1:
        print(f"{n_kinds} kinds of bodies are taken together; --body NAME chooses one")


@dataclass(frozen=True, eq=False)
class _Explained:
    """What `igps explain` shows of two bodies."""

    descriptor: str
    dataset: SignatureDataset
    pair: list[int]  # indices of both bodies
    explanation: Explanation
    painted: list[Painted]
    legend: str  # of what is painted
    lines: list[str]  # to print
    # What each attribute of the descriptor adds to the distance
    attributes: Mapping[str, Explanation]
    moved: Movement | None = None
    meaning: str | None = None  # of the distance, in words


def _explain_pair(result: Described, pair: list[int], descriptor: str) -> _Explained:
    from igps.analysis.explanation import explain as explain_pair
    from igps.analysis.explanation import explain_bodies
    from igps.analysis.superposition import movement
    from igps.data.collation import collate
    from igps.descriptors.with_attributes import split_attributes
    from igps.mesh.surface import vertex_areas

    dataset = result.dataset
    both = dataset.subset(pair)
    moved = movement(*both.bodies)
    form, attributes = split_attributes(result.descriptor)
    explanation = explain_bodies(form, both, moved)
    painted = [
        _painted(dataset, i, places, explanation.distance)
        for i, places in zip(pair, explanation.places, strict=True)
    ]
    meaning = _meaning(descriptor, dataset, explanation.distance)
    lines = [meaning or f"what this distance means is known for {CALIBRATED} alone"]
    if moved is not None:
        lines.append(_moved_words(moved))
    for body in painted:
        areas = vertex_areas(body.mesh.vertices, body.mesh.faces)
        lines.append(f"{body.name}: {_extent(body.values, areas)}")
    one, other = (collate([item.signature]) for item in both)  # with all samples
    told = {name: explain_pair(added, one, other) for name, added in attributes.items()}
    return _Explained(
        form.name, dataset, pair, explanation, painted, _LEGEND, lines, told, moved, meaning
    )


def _explain_groups(folder: Folder, descriptor: str, level: float, **describing: Any) -> _Explained:
    """Explain the medoids of two groups, but paint the mean difference, on the body nearest to the mean."""
    from igps.analysis.dissimilarity import REQUIREMENTS
    from igps.analysis.groups import codes_of, medoids_of, squared_distances
    from igps.cli.places import places_of_groups
    from igps.cli.reading import described
    from igps.descriptors.size_and_side import SIZE

    result = described(folder, descriptor, **describing, also=REQUIREMENTS)
    dataset = result.dataset
    assert folder.check is not None
    labels: Any = folder.check(dataset.bodies)  # without the bodies that could not be used
    _print_kinds(dataset, folder.body)
    coordinates = result.coordinates()
    medoids = medoids_of(squared_distances(coordinates), codes_of(labels))
    found = _explain_pair(result, medoids, descriptor)
    places = places_of_groups(
        dataset,
        range(len(dataset)),
        coordinates,
        labels.tolist(),
        keep_size=SIZE in result.descriptor.name,
        n_workers=describing.get("n_workers"),
        level=level,
    )
    return replace(
        found, painted=[places.painted], legend=places.legend, lines=[places.words], moved=None
    )


def _moved_words(movement: Movement) -> str:
    """Return as text what was superposed, and what is painted."""
    found = movement.correspondence
    steps = sorted(movement.superposition.distances)
    return (
        f"{len(found.pairs)} {found.kind} correspond; after superposition they moved by "
        f"{steps[len(steps) // 2]:.2g} (median), at most {steps[-1]:.2g}; painted: the square of this"
    )


def _meaning(descriptor: str, dataset: SignatureDataset, distance: float) -> str | None:
    """Return in words what a distance means; None if the descriptor or its signatures are not calibrated."""
    from igps.descriptors import descriptor as descriptor_of
    from igps.duplicates.calibration import Calibration

    calibration = Calibration.load()
    try:
        calibration.check(descriptor, descriptor_of(descriptor), dataset.config)
    except ValueError:
        return None
    return calibration.words(distance)


def _painted(
    dataset: SignatureDataset, i: int, shares: Shares, distance: float, *, inside: bool = False
) -> Painted:
    """Return a body with the density of shares of its samples in a distance, over that of an even spread."""
    from igps.analysis.explanation import share_density
    from igps.report.figures import Painted

    mesh = dataset.mesh(i)
    signature = dataset[i].signature
    samples = {kind: getattr(signature, kind).points for kind in shares}
    even = distance / 2 or 1.0

    def density(points: Any) -> Any:
        return share_density(shares, samples, points) / even

    values = density(mesh.vertices)
    return Painted(dataset.bodies.names[i], mesh, values, inside=density if inside else None)


def _extent(values: Any, areas: Any) -> str:
    """Return as text how much of the surface holds half of the positive shares; of vertices, shares and areas (V,)."""
    import numpy as np

    order = np.argsort(-values)
    cumulative = np.cumsum(np.maximum(values, 0)[order] * areas[order])
    if not cumulative[-1]:
        return "none of the difference lies on its surface"
    half = (np.cumsum(areas[order]) / areas.sum())[np.searchsorted(cumulative, cumulative[-1] / 2)]
    return f"half of its share lies on {100 * half:.2g}% of its surface"


def _write(out: Path, found: _Explained, names: Sequence[str]) -> None:
    """Write tables, pictures and files for viewers, of the whole and of each attribute."""
    from igps.report.drawing import file_names
    from igps.report.figures import (
        painted_figure,
        slices_figure,
        write_analysis,
        write_movement,
        write_painted,
    )

    write_analysis(out, "explain_samples", _sample_rows(found))
    figure = painted_figure(found.painted, found.legend, _superposed(found))
    write_analysis(out, "explain", _part_rows(found.explanation), figure)
    files = [f"explain_{name}" for name in file_names([one.name for one in found.painted])]
    write_painted(out, files, found.painted, found.dataset)
    if found.moved is not None:
        write_movement(out, names, found.moved)
    for attribute, told in found.attributes.items():
        painted = []
        rows = []
        for i, shares in zip(found.pair, told.samples, strict=True):
            samples = found.dataset[i].signature.interior
            own: Shares = {"interior": shares["interior"]}
            body = _painted(found.dataset, i, own, told.distance, inside=True)
            painted.append(body)
            columns = {attribute: samples.attributes[attribute], "share": shares["interior"]}
            rows += _rows_at(samples.points, columns, name=body.name)
        write_analysis(out, f"explain_{attribute}", rows, slices_figure(painted, _LEGEND))
        files = [f"explain_{body}_{attribute}" for body in file_names([x.name for x in painted])]
        write_painted(out, files, painted, found.dataset)


def _superposed(found: _Explained) -> list[Any] | None:
    """Return the vertices (V, 3) of two bodies, those of the second after superposition onto the first."""
    if found.moved is None:
        return None
    first, second = found.painted
    motion = found.moved.superposition
    return [first.mesh.vertices, second.mesh.vertices @ motion.rotation.T + motion.shift]


def _part_rows(explanation: Explanation) -> list[dict[str, Any]]:
    return [{"histogram": name, "share": share} for name, share in explanation.parts.items()]


def _sample_rows(found: _Explained) -> list[dict[str, Any]]:
    explanation = found.explanation
    columns_of = zip(found.pair, explanation.samples, explanation.places, strict=True)
    rows = []
    for i, shares, places in columns_of:
        signature = found.dataset[i].signature
        for kind, values in shares.items():
            columns = {"share": values, "share_by_place": places[kind]}
            points = getattr(signature, kind).points
            rows += _rows_at(points, columns, name=found.dataset.bodies.names[i], samples=kind)
    return rows


def _rows_at(points: Any, columns: Mapping[str, Any], **same: str) -> list[dict[str, Any]]:
    """Return a row for each of the points (P, 3), with its place, its number of each column, and what is the same."""
    table = dict(zip("xyz", points.T.tolist(), strict=True))
    table |= {name: values.tolist() for name, values in columns.items()}
    return [
        {**same, **dict(zip(table, row, strict=True))} for row in zip(*table.values(), strict=True)
    ]
