"""The commands `igps groups`, `igps outliers` and `igps explain`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igps._parameters import check_at_least, check_fraction, check_seed
from igps.cli.options import Size

if TYPE_CHECKING:
    from igps.analysis.explanation import Explanation
    from igps.analysis.groups import GroupTest
    from igps.analysis.superposition import Movement
    from igps.cli.reading import Described, Folder
    from igps.data.dataset import SignatureDataset
    from igps.data.sources import Bodies
    from igps.report.figures import Painted


CALIBRATED = "pretrained"
"""The only descriptor whose distances are calibrated, see `igps.duplicates.calibration`."""

_N_NUMBERS = 10  # of `igps groups --inside`, those that are printed


def groups(
    root: Path,
    descriptor: str = "pretrained",
    group: str | None = None,
    strata: str | None = None,
    covariate: list[str] | None = None,
    test_size: bool = False,
    inside: bool = False,
    out: Path | None = None,
    n_permutations: int = 10_000,
    seed: int = 0,
    **reading: Any,
) -> list[dict[str, Any]]:
    """Test whether groups of bodies differ in shape, separately for each named body of the files, such as an organ.

    Two permutation tests are run, PERMANOVA and a kernel two-sample test. The table also has false discovery rates over
    the bodies, the effect size with a 95 % interval, and the cross-validated area under the curve of a classifier.

    Args:
        root: folder with one subfolder per group, or with files and a labels.csv (columns file,label and more).
        group: column of labels.csv that holds the groups; the class if not given.
        strata: column of labels.csv, such as scanner; bodies are permuted only among those with the same value.
        covariate: columns that are regressed out first: numeric, such as age, or categorical, such as sex.
        test_size: also test the size (the logarithm of the volume), in separate lines
        inside: also test where inside the bodies the values of --attribute lie, all numbers of igps inside
            without a unit at once, and each number by itself, with false discovery rates over the numbers.
        out: folder for groups.csv, groups.json, the effects as groups.svg and groups.png, and for each body in which
            two groups differ the places, places_BODY.svg and .png, and .ply, .vtk, .gii and .nii.gz for viewers.
        n_permutations: number of random permutations.
        seed: seed of the permutations, bootstraps and folds.
    """
    import numpy as np

    from igps._progress import Progress
    from igps.analysis.groups import group_test, with_q_values
    from igps.cli.inside import check_has_attribute, inside_vectors
    from igps.cli.reading import Folder, described, print_failures
    from igps.descriptors import descriptor as descriptor_of
    from igps.descriptors.size_and_side import keeps_size
    from igps.mesh.mesh import millimetres
    from igps.report.figures import LEVEL, groups_figure, write_analysis
    from igps.report.tables import groups_table

    check_at_least(1, n_permutations=n_permutations)
    check_seed(seed)
    if inside:
        check_has_attribute(reading)

    def columns(bodies: Bodies) -> tuple[Any, Any, Any]:
        labels = np.array(bodies.labels if group is None else bodies.column(group))
        stratum = None if strata is None else np.array(bodies.column(strata))
        return (
            labels,
            stratum,
            np.hstack([_design(bodies, name) for name in covariate]) if covariate else None,
        )

    folder = Folder(root, labelled=group is None, check=columns)
    # Size counts only where the descriptor's name says so
    size_option: Size = "ignore" if "scale" in descriptor_of(descriptor).invariant_to else "auto"
    result = described(folder, descriptor, size=size_option, **reading)
    bodies = result.dataset.bodies
    labels, stratum, covariates = columns(bodies)
    vectors = {"": result.coordinates(within_class=True)}
    if test_size:
        if warning := keeps_size("keep", result.dataset.units())[1]:
            print(warning)
        vectors[", size"] = np.log(
            [[s.volume * millimetres(s.unit) ** 3] for s in result.dataset.signatures()]
        )
    members = _members(bodies, labels)
    jobs = [
        (body + suffix, i, rows[i])
        for body, i in members.items()
        for suffix, rows in vectors.items()
    ]
    by_number: list[tuple[str, list[int], Any]] = []
    if inside:
        whole, by_number = inside_vectors(folder, bodies, members, **reading)
        jobs += whole

    def tested(jobs: list[tuple[str, list[int], Any]]) -> list[GroupTest]:
        found = []
        for body, i, rows in Progress(jobs, desc="tests"):
            test = group_test(
                rows,
                labels[i].tolist(),
                body=body,
                n_permutations=n_permutations,
                seed=seed,
                strata=None if stratum is None else stratum[i].tolist(),
                covariates=None if covariates is None else covariates[i],
            )
            found.append(test)
        return with_q_values(found)

    tests = tested(jobs)
    numbers = tested(by_number) if by_number else []
    print(groups_table(tests))
    if numbers:
        numbers.sort(key=lambda test: 1 if test.permanova_p is None else test.permanova_p)
        print(f"\nthe first of {len(numbers)} numbers, q over all of them")
        print(groups_table(numbers[:_N_NUMBERS]))
    print_failures(result.failures, len(bodies))
    if out is not None:
        rows = [asdict(test) for test in [*tests, *numbers]]
        for row in rows:
            row["sizes"] = " ".join(f"{name}:{count}" for name, count in row["sizes"].items())
        write_analysis(out, "groups", rows, groups_figure(tests))
        options = {"level": LEVEL, "seed": seed, "n_workers": reading.get("n_workers")}
        differing = [test.body for test in tests if test.differs(LEVEL) and len(test.sizes) == 2]
        for body in differing:
            own = members.get(body, [])  # none of a size
            options["strata"] = None if stratum is None else stratum[own]
            options["covariates"] = None if covariates is None else covariates[own]
            _write_places(result, own, labels[own].tolist(), body, out, **options)
        print(f"written to {out}")
    return [asdict(test) for test in [*tests, *numbers]]


def _members(bodies: Bodies, labels: Any) -> dict[str, list[int]]:
    """Return the indices of the bodies of each kind, such as an organ; "all" if the parts are no kinds."""
    from igps.cli.reading import is_named_after_file

    members: dict[str, list[int]] = {}
    for i, part in enumerate(bodies.parts):
        members.setdefault(part or "all", []).append(i)
    n_pairs = len(set(zip(bodies.parts, labels, strict=True)))
    is_named_by_file = n_pairs == len(bodies) and all(
        map(is_named_after_file, bodies.names, bodies.parts)
    )
    if is_named_by_file or n_pairs == len(members) in (len(set(labels)), len(bodies)):
        # The parts are not organs: they are the groups, or the names of files with one mask each, which may repeat in
        # each group
        return {"all": list(range(len(bodies)))}
    return members


def _write_places(
    result: Described, members: list[int], groups: list[str], body: str, out: Path, **test: Any
) -> None:
    """Write a picture of where two groups of an organ differ."""
    from igps.cli.places import places_of_groups
    from igps.descriptors.size_and_side import SIZE
    from igps.mesh.errors import MeshError
    from igps.report.drawing import file_names, save_figure
    from igps.report.figures import painted_figure, write_painted

    if not members:
        return
    keep_size = SIZE in result.descriptor.name
    vectors = result.coordinates(within_class=True)[members]
    try:
        places = places_of_groups(
            result.dataset, members, vectors, groups, keep_size=keep_size, **test
        )
    except MeshError as error:
        print(f"{body}: no picture: {error}")
        return
    print(f"{body}: {places.words}")
    figure = painted_figure([places.painted], places.legend)
    (name,) = file_names([f"places_{body}"])
    save_figure(figure, out / f"{name}.svg")
    save_figure(figure, out / f"{name}.png", dpi=150)
    write_painted(out, [name], [places.painted], result.dataset)


def _design(bodies: Bodies, name: str) -> Any:
    """Return a column as numbers (N, k): as they are, or one indicator per category where no value is a number."""
    import numpy as np

    words = bodies.column(name)
    if any(re.match(r"[-+.\d]|inf(inity)?$", word, re.IGNORECASE) for word in words):
        return np.array(bodies.numbers(name))[:, None]
    return np.array(
        [[word == category for category in sorted(set(words))] for word in words], dtype=float
    )


def outliers(
    root: Path,
    descriptor: str = "pretrained",
    top: int = 20,
    out: Path | None = None,
    **describing: Any,
) -> list[dict[str, Any]]:
    """List the bodies that are most unlike their class, to review before the collection is used.

    Each body is compared with the others of its class by its shape, volume and resolution; a mesh also by its handles,
    flat sides and repairs; a label also by detached pieces, cavities, holes, gaps, cut ends, and overlap with other
    labels. A score counts robust standard deviations; a body with a score above 3.5 is an outlier. The list also names
    the bodies that are nearer to another class than to their own. Bodies that reach the border of their image are
    compared with those that reach it at the same sides.

    Args:
        root: folder with one subfolder per class, or with files and a labels.csv (columns file,label).
        top: number of bodies to list.
        out: folder for outliers.csv and outliers.json with all bodies, and outliers.svg and outliers.png with pictures
            of the highest-scoring bodies.
    """
    from igps.analysis.groups import squared_distances
    from igps.analysis.outliers import LIMIT, measure_bodies
    from igps.analysis.outliers import outliers as find_outliers
    from igps.cli.reading import Folder, described, print_failures
    from igps.fields.volumes.border import border_of
    from igps.report.figures import outliers_figure, write_analysis

    check_at_least(0, top=top)
    result = described(Folder(root, labelled=True), descriptor, **describing)
    dataset = result.dataset
    distances = squared_distances(result.coordinates()) ** 0.5
    measures = measure_bodies(dataset, n_workers=describing.get("n_workers"))
    files = dataset.bodies.paths
    # Where each file holds one mask, a folder holds the organs of one subject
    subjects = files if len(set(files)) < len(files) else [file.parent for file in files]
    borders = [border_of(notes) for notes in dataset.all_notes()]
    sides = [border.sides if border else "" for border in borders]
    if any(sides):
        n_cut = sum(map(bool, sides))
        print(f"{n_cut} of {len(sides)} bodies reach the border of their image: compared apart")
    ranked = find_outliers(
        distances, dataset.bodies.labels or (), measures, dataset.all_notes(), subjects, sides
    )
    rows: list[dict[str, Any]] = [
        {
            "name": dataset.bodies.names[o.body],
            "class": o.label,
            "score": round(o.score, 3),
            "reason": o.reason,
            **{f"score_{name}": round(value, 3) for name, value in o.scores.items()},
        }
        for o in ranked
    ]
    width = max((len(row["name"]) for row in rows[:top]), default=4)
    print(f"{'score':>7}  {'body':<{width}}  class: reason")
    for row in rows[:top]:
        print(f"{row['score']:>7.1f}  {row['name']:<{width}}  {row['class']}: {row['reason']}")
    print(
        f"{sum(o.is_outlier for o in ranked)} of {len(rows)} bodies are outliers, with a score above {LIMIT}"
    )
    print_failures(result.failures, len(dataset))
    if out is not None:
        pictured = [
            (o, dataset.bodies.names[o.body], dataset.mesh(o.body)) for o in ranked[: min(top, 12)]
        ]
        write_analysis(out, "outliers", rows, outliers_figure(pictured) if pictured else None)
        print(f"written to {out}")
    return rows


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
    moved: Movement | None = None
    meaning: str | None = None  # of the distance, in words
    # What each attribute of the descriptor adds to the distance
    attributes: Mapping[str, Explanation] = field(default_factory=dict)


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
        meshes: two files, or a folder with two groups.
        descriptor: a descriptor made of histograms, such as interior, rich or pretrained.
        group: column of labels.csv that holds the groups of a folder; the class if not given.
        body: of a folder, only the bodies of this name in their files, such as an organ.
        axis: of a folder, the two bodies at the ends of axis 1 or 2 of its map, see igps map, between which its
            bodies vary most; without groups.
        level: family-wise error rate, for two groups: only histogram cells and places that differ significantly count.
        out: folder for explain.csv (shares of the histograms), explain_samples.csv (shares of the samples), and
            explain.svg and explain.png: two bodies painted with their shares, or the mean difference of two groups;
            the same for viewers as explain_BODY.ply, .vtk, .gii and .nii.gz; of each attribute of --with also
            explain_ATTRIBUTE.csv and slices, and explain_BODY_ATTRIBUTE for viewers;
            of two molecules of one sequence also explain_residues.csv, and both superposed as explain_1.cif and
            explain_2.cif with the shares of residues in percent in place of B-factors.
    """
    from igps.analysis.explanation import without_head
    from igps.cli.reading import Folder, check_files, files_or_folder
    from igps.descriptors import descriptor as descriptor_of
    from igps.descriptors.with_attributes import split_attributes
    from igps.report.drawing import file_names
    from igps.report.figures import painted_figure, write_analysis, write_movement, write_painted

    check_fraction(level=level)
    if axis not in (None, 1, 2):
        raise ValueError(f"axis: expected 1 or 2, got {axis}.")
    source = files_or_folder(meshes)
    if axis is not None and group is not None:
        raise ValueError("axis, group: expected one of them. Leave the other out.")
    if not isinstance(source, Folder):
        if len(source) != 2:
            raise ValueError(
                f"meshes: expected two files, or a folder of two groups, got {len(source)} files."
            )
        if (group, body, axis) != (None, None, None):
            raise ValueError(
                "group, body, axis: expected a folder with them, got files. Leave them out."
            )
        check_files(source)
    # Raises for other descriptors before anything is computed
    without_head(split_attributes(descriptor_of(descriptor))[0])
    if not isinstance(source, Folder):
        found = _explain_files(source, descriptor, **describing)
    elif axis is not None:
        found = _explain_axis(Folder(source.root, body=body), descriptor, axis, **describing)
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
    parts = [{"histogram": name, "share": share} for name, share in explanation.parts.items()]
    if out is not None:
        rows = _sample_rows(found.dataset, found.pair, explanation)
        write_analysis(out, "explain_samples", rows)
        superposed = _superposed(found.painted, found.moved)
        figure = painted_figure(found.painted, found.legend, superposed)
        write_analysis(out, "explain", parts, figure)
        files = [f"explain_{name}" for name in file_names([one.name for one in found.painted])]
        write_painted(out, files, found.painted, found.dataset)
        if found.moved is not None:
            write_movement(out, names, found.moved)
        _write_attributes(out, found)
        print(f"written to {out}")
    return {
        "bodies": names,
        "distance": explanation.distance,
        "meaning": found.meaning,
        "shares": parts,
        "attributes": {name: told.distance for name, told in found.attributes.items()},
    }


def _write_attributes(out: Path, found: _Explained) -> None:
    """Write the share of each attribute back on both bodies: tables, slices, and files for viewers."""
    from igps.report.drawing import file_names
    from igps.report.figures import slices_figure, write_analysis, write_painted

    legend = "share of the distance, over that of an even spread"
    for name, told in found.attributes.items():
        painted = []
        rows = []
        for i, shares in zip(found.pair, told.samples, strict=True):
            samples = found.dataset[i].signature.interior
            body = _painted_inside(found.dataset, i, shares["interior"], told.distance)
            painted.append(body)
            values = samples.attributes[name].tolist()
            columns = zip(samples.points.tolist(), values, shares["interior"].tolist(), strict=True)
            for point, value, share in columns:
                place = dict(zip("xyz", point, strict=True))
                rows.append({"name": body.name, **place, name: value, "share": share})
        write_analysis(out, f"explain_{name}", rows, slices_figure(painted, legend))
        files = [f"explain_{body}_{name}" for body in file_names([one.name for one in painted])]
        write_painted(out, files, painted, found.dataset)


def _explain_groups(folder: Folder, descriptor: str, level: float, **describing: Any) -> _Explained:
    """Return the medoids of two groups, and their mean difference, painted on the body nearest to the mean."""
    import numpy as np

    from igps.analysis.explanation import explain as explain_pair
    from igps.analysis.explanation import explain_groups, without_head
    from igps.analysis.groups import squared_distances
    from igps.cli.places import places_of_groups
    from igps.cli.reading import described
    from igps.data.collation import collate
    from igps.descriptors.fingerprint import cache_tag
    from igps.descriptors.size_and_side import SIZE
    from igps.descriptors.with_attributes import split_attributes
    from igps.nn.description import describe

    result = described(folder, descriptor, **describing)
    dataset = result.dataset
    assert folder.check is not None
    labels: Any = folder.check(dataset.bodies)  # without the bodies that could not be used
    _print_kinds(dataset, folder.body)
    form, attributes = split_attributes(result.descriptor)
    inner = without_head(form)
    n_workers = describing.get("n_workers")
    descriptions = describe(
        dataset, inner, cache_tag=cache_tag(inner), n_workers=n_workers, progress=True
    )
    members = [np.flatnonzero(labels == name) for name in sorted(set(labels))]
    squares = squared_distances(inner.coordinates(descriptions).double().numpy())
    # The medoids
    pair = [int(own[squares[np.ix_(own, own)].sum(axis=1).argmin()]) for own in members]
    one, other = (collate([dataset[i].signature]) for i in pair)  # with all samples
    first, second = (descriptions[own] for own in members)
    explanation, is_significant = explain_groups(form, first, second, [one, other], level=level)
    n_cells = f"{int(is_significant.sum())} of {len(is_significant)}"
    print(f"{n_cells} cells differ significantly; their samples: in the medoid of each group")
    places = places_of_groups(
        dataset,
        range(len(dataset)),
        result.coordinates(),
        labels.tolist(),
        keep_size=SIZE in result.descriptor.name,
        n_workers=n_workers,
        level=level,
    )
    return _Explained(
        form.name,
        dataset,
        pair,
        explanation,
        [places.painted],
        places.legend,
        [places.words],
        attributes={name: explain_pair(added, one, other) for name, added in attributes.items()},
    )


def _explain_axis(folder: Folder, descriptor: str, axis: int, **describing: Any) -> _Explained:
    """Return the two bodies of a folder at the ends of an axis of its map."""
    from igps.analysis.comparison import pair_distances
    from igps.analysis.map import ends_of_axis
    from igps.cli.reading import described

    result = described(folder, descriptor, **describing)
    _print_kinds(result.dataset, folder.body)
    distances = pair_distances(result.descriptor, result.descriptions, progress=True)
    ends, share = ends_of_axis(distances.double().numpy(), axis)
    n = len(result.dataset)
    print(
        f"axis {axis} of the map has {share:.0%} of the squared distances of {n} bodies; its ends:"
    )
    return _explain_pair(result, list(ends), descriptor)


def _explain_files(files: Sequence[Path], descriptor: str, **describing: Any) -> _Explained:
    from igps.cli.reading import described

    result = described(files, descriptor, **{**describing, "strict": True})
    names = result.dataset.bodies.names
    if len(names) != 2:
        listed = ", ".join(names[:4])
        raise ValueError(
            f"meshes: expected two bodies, got {len(names)}: {listed}. Name each as FILE#PART."
        )
    return _explain_pair(result, [0, 1], descriptor)


def _explain_pair(result: Described, pair: list[int], descriptor: str) -> _Explained:
    from igps.analysis.explanation import explain as explain_pair
    from igps.analysis.explanation import explain_bodies
    from igps.analysis.superposition import movement
    from igps.data.collation import collate
    from igps.descriptors.with_attributes import split_attributes

    dataset = result.dataset.subset(pair)
    moved = movement(*dataset.bodies)
    form, attributes = split_attributes(result.descriptor)
    explanation = explain_bodies(form, dataset, moved)
    one, other = (collate([item.signature]) for item in dataset)  # with all samples
    painted = [_painted(dataset, i, explanation, i) for i in (0, 1)]
    legend = "share of the distance, over that of an even spread"
    meaning = _meaning(descriptor, dataset, explanation.distance)
    lines = [meaning or f"what this distance means is known for {CALIBRATED} alone"]
    lines += _extents(painted, moved)
    told = {name: explain_pair(added, one, other) for name, added in attributes.items()}
    return _Explained(
        form.name, dataset, [0, 1], explanation, painted, legend, lines, moved, meaning, told
    )


def _print_kinds(dataset: SignatureDataset, body: str | None) -> None:
    n_kinds = len(set(dataset.bodies.parts))
    if body is None and n_kinds > 1:
        print(f"{n_kinds} kinds of bodies are taken together; --body NAME chooses one")


def _extents(painted: Sequence[Painted], movement: Movement | None) -> list[str]:
    """Return in words what is painted, and how much of each surface holds half of the paint."""
    from igps.mesh.surface import vertex_areas

    lines = [] if movement is None else [_moved_words(movement)]
    for one in painted:
        areas = vertex_areas(one.mesh.vertices, one.mesh.faces)
        lines.append(f"{one.name}: {_extent(one.values, areas)}")
    return lines


def _moved_words(movement: Movement) -> str:
    """Return as text what was superposed, and what is painted."""
    found = movement.correspondence
    steps = sorted(movement.superposition.distances)
    return (
        f"{len(found.pairs)} {found.kind} correspond; painted: the square of how far they moved after superposition "
        f"(median {steps[len(steps) // 2]:.2g}, largest {steps[-1]:.2g})"
    )


def _superposed(painted: Sequence[Painted], movement: Movement | None) -> list[Any] | None:
    """Return the vertices (V, 3) of two bodies, those of the second after superposition onto the first."""
    if movement is None:
        return None
    first, second = painted
    motion = movement.superposition
    return [first.mesh.vertices, second.mesh.vertices @ motion.rotation.T + motion.shift]


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


def _two_groups(bodies: Bodies, group: str | None) -> Any:
    """Return the group of each body (N,) as an array; raise a ValueError unless there are two groups."""
    import numpy as np

    labels = np.array((bodies.labels or ()) if group is None else bodies.column(group))
    names = sorted(set(labels.tolist()))
    if len(names) != 2:
        listed = ", ".join(names[:5])
        raise ValueError(f"meshes: expected a folder of two groups, got {len(names)}: {listed}.")
    return labels


def _painted(dataset: SignatureDataset, i: int, explanation: Explanation, side: int) -> Painted:
    """Return a body with the shares of its vertices in the distance, over those of an even spread; `side` is 0 or 1."""
    from igps.analysis.explanation import share_density
    from igps.report.figures import Painted
    from igps.signature.signature import SAMPLE_KINDS

    mesh = dataset.mesh(i)
    signature = dataset[i].signature
    samples = {kind: getattr(signature, kind).points for kind in SAMPLE_KINDS}
    shares = (explanation.places or explanation.samples)[side]
    density = share_density(shares, samples, mesh.vertices)
    even = explanation.distance / 2 or 1.0
    return Painted(dataset.bodies.names[i], mesh, density / even)


def _painted_inside(dataset: SignatureDataset, i: int, shares: Any, distance: float) -> Painted:
    """Return a body with the shares (P,) of its interior samples in a distance, over those of an even spread."""
    from igps.analysis.explanation import share_density
    from igps.report.figures import Painted

    mesh = dataset.mesh(i)
    points = dataset[i].signature.interior.points

    def inside(places: Any) -> Any:
        density = share_density({"interior": shares}, {"interior": points}, places)
        return density / (distance / 2 or 1.0)

    return Painted(dataset.bodies.names[i], mesh, inside(mesh.vertices), inside=inside)


def _extent(values: Any, areas: Any) -> str:
    """Return as text how much of the surface holds half of the positive shares; of vertices, shares and areas (V,)."""
    import numpy as np

    order = np.argsort(-values)
    cumulative = np.cumsum(np.maximum(values, 0)[order] * areas[order])
    if not cumulative[-1]:
        return "none of the difference lies on its surface"
    half = (np.cumsum(areas[order]) / areas.sum())[np.searchsorted(cumulative, cumulative[-1] / 2)]
    return f"half of its share lies on {100 * half:.2g}% of its surface"


def _sample_rows(
    dataset: SignatureDataset, pair: list[int], explanation: Explanation
) -> list[dict[str, Any]]:
    from igps.signature.signature import SAMPLE_KINDS

    by_place = explanation.places or explanation.samples
    return [
        {
            "name": dataset.bodies.names[i],
            "samples": kind,
            **dict(zip("xyz", point, strict=True)),
            "share": float(share),
            "share_by_place": float(placed),
        }
        for i, shares, places in zip(pair, explanation.samples, by_place, strict=True)
        for kind in SAMPLE_KINDS
        for point, share, placed in zip(
            getattr(dataset[i].signature, kind).points.tolist(),
            shares[kind],
            places[kind],
            strict=True,
        )
    ]
