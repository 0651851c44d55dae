"""Scores of the named descriptors on SHREC'07, compared with the table of expected scores beside this script.

`python tests/campaign/shrec07.py FOLDER` ends with status 1 if a score differs. `--write` stores the measured scores as
the expected ones.
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
# Scores are compared with the precision of the documentation, tenths of a percent.
_POINT = 10

Table = Mapping[str, Mapping[str, float]]


def measure(folder: Path, names: list[str], cache_dir: Path | None, n_workers: int | None) -> Table:
    """Measure the scores of each descriptor with the parameters of the paper, in percent, rounded to tenths."""
    descriptors = {name: descriptor(name) for name in names}
    requirements = Requirements()
    for module in descriptors.values():
        requirements = requirements | module.requirements
    config = requirements.apply_to(SignatureConfig.paper())
    dataset = SignatureDataset(
        find_bodies(folder, labelled=True), config, cache_dir, reading=LoadOptions()
    )
    dataset.precompute(n_workers=n_workers, strict=True)
    table = {}
    for name, module in descriptors.items():
        failures: list[Failure] = []
        descriptions = describe(
            dataset, module, failures=failures, n_workers=n_workers, progress=True
        )
        distances = pair_distances(module, descriptions)
        means = retrieval_scores(distances, dataset.usable(failures).bodies.labels or ()).mean()
        table[name] = {
            score: round(100 * _POINT * float(means[score])) / _POINT for score in SCORES
        }
        table[name]["n_described"] = len(descriptions)
    return table


def differences(measured: Table, expected: Table) -> list[str]:
    """Describe each difference from the expected scores in a sentence."""
    sentences = []
    for name, scores in measured.items():
        if name not in expected:
            sentences.append(f"{name}: there are no expected scores; store these with --write")
            continue
        for score, value in scores.items():
            if value != expected[name].get(score):
                sentences.append(
                    f"{name}: {score} is {value}, expected {expected[name].get(score)}"
                )
    return sentences


def main() -> None:
    """Compare the scores with the expected ones, or store them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder of the SHREC'07 meshes, with labels.csv")
    parser.add_argument(
        "--descriptors", nargs="+", choices=NAMES, help="default: those with expected scores"
    )
    parser.add_argument(
        "--cache_dir", type=Path, help="cache of signatures; default: the user's cache"
    )
    parser.add_argument("--n_workers", type=int, help="number of processes; default: all cores")
    parser.add_argument(
        "--write", action="store_true", help="store the scores as the expected ones"
    )
    arguments = parser.parse_args()
    expected: dict[str, Mapping[str, float]] = (
        json.loads(EXPECTED.read_text()) if EXPECTED.exists() else {}
    )
    names = arguments.descriptors or list(expected) or list(NAMES)
    measured = measure(arguments.folder, names, arguments.cache_dir, arguments.n_workers)
    for name, scores in measured.items():
        print(f"{name:<28}" + "".join(f"{score} {value:<8g}" for score, value in scores.items()))
    if arguments.write:
        EXPECTED.write_text(json.dumps({**expected, **measured}, indent=2) + "\n")
        print(f"written to {EXPECTED}")
        return
    sentences = differences(measured, expected)
    print("\n".join(sentences) or "as expected")
    sys.exit(bool(sentences))


if __name__ == "__main__":
    main()
