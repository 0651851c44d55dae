"""`igps groups`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from igps.analysis.groups import group_test, vectors_of, with_discovery_rates
from igps.cli.reading import Folder, described, print_failures
from igps.report.answers import groups_figure, write_answer
from igps.report.tables import groups_table


def groups(
    root: Path,
    descriptor: str = "pretrained",
    group: str | None = None,
    strata: str | None = None,
    covariate: list[str] | None = None,
    size: bool = False,
    out: Path | None = None,
    n_permutations: int = 10_000,
    seed: int = 0,
    **reading: Any,
) -> list[dict[str, Any]]:
    """Test whether groups of bodies differ in shape: each named body of the files, such as an organ, by itself.

    Two tests by permutation, PERMANOVA and a kernel two-sample test; how large the difference is, with its interval;
    the area under the curve of a classifier by cross-validation; and false discovery rates over the bodies.

    Args:
        root: folder with one subfolder per group, or with files and a labels.csv (columns file,label and more).
        group: a column of labels.csv that tells the groups; the class if not given.
        strata: a column within whose values bodies are permuted, such as scanner.
        covariate: columns of numbers that are regressed out first, such as age.
        size: test the size, too, the logarithm of the volume, in lines of its own
        out: folder for groups.csv, groups.json, and the effects as groups.svg and groups.png.
        n_permutations: random ones.
        seed: of what is random.
    """
    found = described(Folder(root, labelled=group is None), descriptor, size="ignore", **reading)
    bodies = found.dataset.bodies
    vectors = {"": vectors_of(found.descriptor, found.descriptions)}
    if size:
        vectors[", size"] = np.log([[one.volume] for one in found.dataset.signatures()])
    labels = np.array(bodies.labels if group is None else bodies.column(group))
    of_strata = None if strata is None else np.array(bodies.column(strata))
    of_covariates = np.array([bodies.numbers(name) for name in covariate]).T if covariate else None
    members: dict[str, list[int]] = {}
    for i, part in enumerate(bodies.parts):
        members.setdefault(part or "all", []).append(i)
    jobs = [(body + what, places, rows[places]) for body, places in members.items() for what, rows in vectors.items()]
    tests = with_discovery_rates([
        group_test(
            rows, labels[places].tolist(), body=body, n_permutations=n_permutations, seed=seed,
            strata=None if of_strata is None else of_strata[places].tolist(),
            covariates=None if of_covariates is None else of_covariates[places],
        )
        for body, places, rows in tqdm(jobs, desc="tests")
    ])  # fmt: skip
    print(groups_table(tests))
    print_failures(found.failures, len(bodies))
    if out is not None:
        rows = [asdict(one) for one in tests]
        for row in rows:
            row["sizes"] = " ".join(f"{name}:{count}" for name, count in row["sizes"].items())
        write_answer(out, "groups", rows, groups_figure(tests))
        print(f"written to {out}")
    return [asdict(one) for one in tests]
