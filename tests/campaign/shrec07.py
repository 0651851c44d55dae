"""The headline figures: what the named descriptors score on SHREC'07, against the table kept beside this script.

`python tests/campaign/shrec07.py FOLDER` compares, and ends with status 1 on a difference; `--write` keeps what it
finds as what is expected.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path

from igps import LoadOptions, SignatureConfig, SignatureDataset, descriptor, retrieval_scores
from igps.analysis.comparison import pair_distances
from igps.data.dataset import Failure
from igps.data.requirements import Requirements
from igps.data.sources import find_bodies
from igps.descriptors import NAMES
from igps.nn.description import describe

EXPECTED = Path(__file__).with_name("shrec07.json")
SCORES = ("nn", "ft", "st", "dcg")
# Scores are compared as the documentation prints them, in percent to a tenth.
_POINT = 10

Table = Mapping[str, Mapping[str, float]]


def measure(folder: Path, names: list[str], cache_dir: Path | None, n_workers: int | None) -> Table:
    """The scores in percent, to a tenth, by descriptor; the paper's parameters."""
    descriptors = {name: descriptor(name) for name in names}
    requirements = Requirements()
    for one in descriptors.values():
        requirements = requirements | one.requirements
    config = requirements.apply_to(SignatureConfig.paper())
    dataset = SignatureDataset(find_bodies(folder, labelled=True), config, cache_dir, reading=LoadOptions())
    dataset.precompute(n_workers=n_workers, strict=True)
    found = {}
    for name, one in descriptors.items():
        failures: list[Failure] = []
        descriptions = describe(dataset, one, failures=failures, n_workers=n_workers, progress=True)
        distances = pair_distances(one, descriptions)
        means = retrieval_scores(distances, dataset.usable(failures).bodies.labels or ()).mean()
        found[name] = {score: round(100 * _POINT * float(means[score])) / _POINT for score in SCORES}
        found[name]["n_described"] = len(descriptions)
    return found


def differences(found: Table, expected: Table) -> list[str]:
    """What differs from what is expected, in words."""
    words = []
    for name, scores in found.items():
        if name not in expected:
            words.append(f"{name}: no scores are expected yet; keep these by --write")
            continue
        for score, value in scores.items():
            if value != expected[name].get(score):
                words.append(f"{name}: {score} is {value}, expected {expected[name].get(score)}")
    return words


def main() -> None:
    """Compare the scores with those expected, or keep them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="the SHREC'07 meshes, with labels.csv")
    parser.add_argument("--descriptors", nargs="+", choices=NAMES, help="those with expected scores by default")
    parser.add_argument("--cache_dir", type=Path, help="of signatures; the user's if not given")
    parser.add_argument("--n_workers", type=int, help="processes; all cores if not given")
    parser.add_argument("--write", action="store_true", help="keep the scores as those that are expected")
    arguments = parser.parse_args()
    expected: dict[str, Mapping[str, float]] = json.loads(EXPECTED.read_text()) if EXPECTED.exists() else {}
    names = arguments.descriptors or list(expected) or list(NAMES)
    found = measure(arguments.folder, names, arguments.cache_dir, arguments.n_workers)
    for name, scores in found.items():
        print(f"{name:<28}" + "".join(f"{score} {value:<8g}" for score, value in scores.items()))
    if arguments.write:
        EXPECTED.write_text(json.dumps({**expected, **found}, indent=2) + "\n")
        print(f"written to {EXPECTED}")
        return
    wrong = differences(found, expected)
    print("\n".join(wrong) or "as expected")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
