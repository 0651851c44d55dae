"""The command `igps groups`."""

from __future__ import annotations

import re
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from igps._parameters import check_at_least, check_seed
from igps.cli.shared_options import Size

if TYPE_CHECKING:
    from igps.analysis.groups import GroupTest
    from igps.cli.reading import Described
    from igps.data.dataset import SignatureDataset
    from igps.data.sources import Bodies

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
    from igps._progress import Progress
    from igps.analysis.groups import group_test, with_q_values
    from igps.cli.inside_command import check_has_attribute, inside_vectors
    from igps.cli.reading import Folder, described
    from igps.descriptors import descriptor as descriptor_of
    from igps.report.figures import LEVEL, groups_figure, write_analysis
    from igps.report.tables import groups_table

    check_at_least(1, n_permutations=n_permutations)
    check_seed(seed)
    if inside:
        check_has_attribute(reading)

    columns = partial(_columns, group=group, strata=strata, covariate=covariate)
    folder = Folder(root, labelled=group is None, check=columns)
    # Size counts only where the descriptor's name says so
    size_option: Size = "ignore" if "scale" in descriptor_of(descriptor).invariant_to else "auto"
    result = described(folder, descriptor, size=size_option, **reading)
    bodies = result.dataset.bodies
    labels, stratum, covariates = columns(bodies)
    vectors = {"": result.coordinates(within_class=True)}
    if test_size:
        vectors[", size"] = _log_volumes(result.dataset)
    members = _members(bodies, labels)
    jobs = []
    for body, own in members.items():
        for suffix, of_bodies in vectors.items():
            jobs.append((body + suffix, own, of_bodies[own]))
    by_number: list[tuple[str, list[int], Any]] = []
    if inside:
        whole, by_number = inside_vectors(folder, bodies, members, **reading)
        jobs += whole

    def tested(jobs: list[tuple[str, list[int], Any]]) -> list[GroupTest]:
        found = []
        for body, own, rows in Progress(jobs, desc="tests"):
            test = group_test(
                rows,
                labels[own].tolist(),
                body=body,
                n_permutations=n_permutations,
                seed=seed,
                strata=None if stratum is None else stratum[own].tolist(),
                covariates=None if covariates is None else covariates[own],
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


def _columns(
    bodies: Bodies, group: str | None, strata: str | None, covariate: list[str] | None
) -> tuple[Any, Any, Any]:
    """Return the groups (N,), the strata (N,) and the covariates (N, k) of bodies by columns of labels.csv, or None."""
    import numpy as np

    labels = np.array(bodies.labels if group is None else bodies.column(group))
    stratum = None if strata is None else np.array(bodies.column(strata))
    covariates = None
    if covariate:
        covariates = np.hstack([_design(bodies, name) for name in covariate])
    return labels, stratum, covariates


def _log_volumes(dataset: SignatureDataset) -> Any:
    """Return the logarithms (N, 1) of volumes, in mm³; print a warning if a unit is not known."""
    import numpy as np

    from igps.descriptors.size_and_side import keeps_size
    from igps.mesh.mesh import millimetres

    _, warning = keeps_size("keep", dataset.units())
    if warning:
        print(warning)
    volumes = []
    for signature in dataset.signatures():
        volumes.append(signature.volume * millimetres(signature.unit) ** 3)
    return np.log(volumes)[:, None]


def _members(bodies: Bodies, labels: Any) -> dict[str, list[int]]:
    """Return the indices of the bodies of each kind, such as an organ; "all" if the parts are no kinds."""
    from igps.cli.reading import is_named_after_file

    members: dict[str, list[int]] = {}
    for i, part in enumerate(bodies.parts):
        members.setdefault(part or "all", []).append(i)
    n_pairs = len(set(zip(bodies.parts, labels, strict=True)))
    are_named_by_file = all(map(is_named_after_file, bodies.names, bodies.parts))
    # The parts are not organs: they are the names of files with one mask each, which may repeat in each group
    are_files = n_pairs == len(bodies) and are_named_by_file
    # or they are the groups
    are_groups = n_pairs == len(members) and len(members) in (len(set(labels)), len(bodies))
    if are_files or are_groups:
        return {"all": list(range(len(bodies)))}
    return members


def _write_places(
    result: Described, members: list[int], groups: list[str], body: str, out: Path, **test: Any
) -> None:
    """Write a picture of where two groups of an organ differ."""
    from igps.cli.places import places_of_groups
    from igps.descriptors.size_and_side import SIZE
    from igps.mesh.errors import MeshError
    from igps.report.drawing import file_names
    from igps.report.figures import painted_figure, save_both, write_painted

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
    save_both(figure, out / name)
    write_painted(out, [name], [places.painted], result.dataset)


def _design(bodies: Bodies, name: str) -> Any:
    """Return a column as numbers (N, k): as they are, or one indicator per category where no value is a number."""
    import numpy as np

    words = bodies.column(name)
    if any(re.match(r"[-+.\d]|inf(inity)?$", word, re.IGNORECASE) for word in words):
        return np.array(bodies.numbers(name))[:, None]
    categories = np.array(sorted(set(words)))
    return (np.array(words)[:, None] == categories).astype(float)
