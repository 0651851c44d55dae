"""The README's Python examples run as they are printed, and print what they must; its commands exist."""

from __future__ import annotations

import ast
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from sklearn.svm import SVC

from igps.cli import COMMANDS, main
from igps.data.dataset import SignatureDataset
from igps.descriptors import NAMES
from igps.shapes import ArticulatedShapes
from paper_histogram import paper_histogram

PROJECT = Path(__file__).parents[1]
README = (PROJECT / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
SHELL = "\n".join(re.findall(r"```sh\n(.*?)```", README, flags=re.DOTALL))
SCORES = ["nn", "ft", "st", "e", "dcg", "adr", "adr_self", "map"]


def run(folder: Path, *arguments: str) -> str:
    environment = {**os.environ, "PYTHONPATH": f"{PROJECT / 'src'}{os.pathsep}{folder}"}
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def first_tier(distances: np.ndarray, labels: list[str]) -> tuple[float, float]:
    """NN and FT by hand: of each query, is the nearest of its class, and what share of its class is among as many."""
    nearest, tiers = [], []
    for i, row in enumerate(distances):
        others = [j for j in np.argsort(row, kind="stable") if j != i]
        relevant = [labels[j] == labels[i] for j in others]
        nearest.append(relevant[0])
        tiers.append(np.mean(relevant[: sum(relevant)]))
    return float(np.mean(nearest)), float(np.mean(tiers))


def test_there_are_three_examples() -> None:
    assert len(EXAMPLES) == 3


def test_the_ten_lines_print_scores_and_the_nearest(tmp_path: Path) -> None:
    (tmp_path / "example.py").write_text(EXAMPLES[0])
    assert len([line for line in EXAMPLES[0].splitlines() if line]) <= 10
    scores, nearest = run(tmp_path, "example.py").splitlines()
    found = ast.literal_eval(scores)
    assert list(found) == SCORES
    dataset = SignatureDataset(tmp_path / "shapes", cache_dir=tmp_path / "cache")
    signatures = [dataset[i].signature for i in range(6)]
    cells = [paper_histogram(one.interior.eigenfunctions, one.eigenvalues).ravel() for one in signatures]
    distances = np.array([[np.sum((a - b) ** 2 / np.maximum(a + b, 1e-300)) / 2 for b in cells] for a in cells])
    labels = list(dataset.files.labels or ())
    assert (found["nn"], found["ft"]) == pytest.approx(first_tier(distances, labels))
    expected = [dataset.files.names[i] for i in np.argsort(distances[0], kind="stable")[:3]]
    assert ast.literal_eval(nearest) == expected
    assert expected[0] == dataset.files.names[0]


def test_the_descriptor_of_ones_own_runs_by_its_place(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(EXAMPLES[1])
    assert len([line for line in EXAMPLES[1].splitlines() if line]) <= 10
    ArticulatedShapes(n_classes=2, n_per_class=3, n_vertices=600).write(tmp_path / "shapes")
    options = ["--signature.n_eigenpairs", "5", "--n_workers", "1", "--cache_dir", "cache", "--out", "out"]
    run(tmp_path, "-m", "igps.cli", "retrieve", "shapes", "--descriptor", "mine:Roundness", *options)
    with np.load(tmp_path / "out" / "distances.npz") as archive:
        distances, names, labels = archive["distances"], archive["names"], archive["labels"]
    bodies = [trimesh.load(tmp_path / "shapes" / name) for name in names]
    roundness = np.array([abs(body.volume) / body.area**1.5 for body in bodies])
    expected = np.abs(roundness[:, None] - roundness)
    np.testing.assert_allclose(distances, expected, atol=1e-6)
    scores = json.loads((tmp_path / "out" / "scores.json").read_text())
    assert (scores["nn"], scores["ft"]) == pytest.approx(first_tier(distances, list(labels)))


def test_the_classifier_tells_its_classes_apart(tmp_path: Path) -> None:
    (tmp_path / "example.py").write_text(EXAMPLES[2])
    name, score = run(tmp_path, "example.py").split()
    paths = sorted((tmp_path / "shapes").rglob("*.off"))
    assert name == f"{paths[0].parent.name}/00"
    dataset = SignatureDataset(paths, cache_dir=tmp_path / "cache")
    signatures = [dataset[i].signature for i in range(len(paths))]
    cells = [paper_histogram(one.interior.eigenfunctions, one.eigenvalues).ravel() for one in signatures]
    labels = [path.parent.name for path in paths]
    expected = SVC().fit(np.sqrt(cells), labels).score(np.sqrt(cells), labels)
    assert expected > 0.5  # by guessing
    assert float(score) == expected


def test_targets_of_make_exist() -> None:
    makefile = (PROJECT / "Makefile").read_text()
    targets = re.findall(r"`?make ([a-z0-9]+)", README)
    assert targets
    for target in targets:
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target


def test_commands_and_their_options_exist(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    commands = [part.split("#")[0].strip() for line in SHELL.splitlines() for part in line.split(";")]
    commands = [command for command in commands if command.startswith("igps ")]
    inline = re.findall(rf"`(?:PYTHONPATH=\. )?(igps (?:{'|'.join(COMMANDS)})[^`]*)`", README)
    assert len(commands) > 6
    assert inline
    for command in commands + inline:
        words = shlex.split(command)[1:]
        known = 2 if words[0] == "figure" else 1
        monkeypatch.setattr(sys, "argv", ["igps", *words[:known], "--help"])
        with pytest.raises(SystemExit, match="0"):
            main()
        text = capsys.readouterr().out
        for option in [word for word in words if word.startswith("--")]:
            assert re.search(rf"{option}\b", text), f"{command}: no option {option}"


def test_descriptors_are_named() -> None:
    for name in NAMES:
        assert f"`{name}`" in README, name
