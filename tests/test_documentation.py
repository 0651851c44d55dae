"""The Python of README and documentation runs as it is printed, and prints what it says; commands and links exist."""

from __future__ import annotations

import ast
import json
import os
import pydoc
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from sklearn.svm import SVC

import commands
import igps
from igps.cli.commands import command_of, load_command
from igps.data.dataset import SignatureDataset
from igps.descriptors import NAMES
from page_packages import install
from paper_histogram import paper_histogram

PROJECT = Path(__file__).parents[1]
README = PROJECT / "README.md"
PAGES = [README, PROJECT / "CONTRIBUTING.md", *sorted((PROJECT / "docs").rglob("*.md"))]
TEXT = {path.relative_to(PROJECT).as_posix(): path.read_text(encoding="utf-8") for path in PAGES}
SCORES = ["nn", "ft", "st", "e", "dcg", "adr", "adr_self", "map"]
WIDTH = 120  # of lines of prose


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, the file that its title names, and its text."""

    language: str
    title: str | None
    text: str


def blocks(page):
    fence = r'^```(\w*)(?: title="([^"]+)")?\n(.*?)^```'
    found = re.findall(fence, TEXT[page], flags=re.DOTALL | re.MULTILINE)
    return [Block(language, title or None, text) for language, title, text in found]


def python(page):
    return [block for block in blocks(page) if block.language == "python"]


def run_alone(folder, *arguments):
    """Run Python in a process of its own, and return what it prints."""
    paths = [str(PROJECT / "src"), str(folder), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="session")
def shared_cache(tmp_path_factory):
    """Signatures for all pages, many of which make the same bodies; under xdist, for all processes."""
    base = tmp_path_factory.getbasetemp()
    place = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder = place / "cache of pages"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture
def folder(here, on_path, shared_cache):
    """The current folder, on the path of Python, whose cache is shared. What is imported from it is forgotten."""
    (here / "cache").symlink_to(shared_cache)
    before = set(sys.modules)
    yield here
    for name in set(sys.modules) - before:
        file = getattr(sys.modules[name], "__file__", None)
        if file and Path(file).is_relative_to(here):
            del sys.modules[name]


def program(page, folder):
    """The blocks of a page as one program, those with a title written as files; and what it has to print.

    Output that a page shows, in a text block after the code, must be printed next.
    """
    code = []
    expected = []
    for i, block in enumerate(blocks(page)):
        if block.language == "python" and block.title:
            (folder / block.title).write_text(block.text)
        elif block.title == "pyproject.toml":
            install(block.text, folder)
        elif block.language == "python":
            ast.parse(block.text)
            code.append(block.text)
        elif block.language == "text" and i and blocks(page)[i - 1].language == "python":
            expected.append(block.text)
    return "\n".join(code), "".join(expected)


def first_tier(distances, labels):
    """NN and FT by hand: of each query, is the nearest of its class, and what share of its class is among as many."""
    nearest = []
    tiers = []
    for i, row in enumerate(distances):
        others = [j for j in np.argsort(row, kind="stable") if j != i]
        relevant = [labels[j] == labels[i] for j in others]
        nearest.append(relevant[0])
        tiers.append(np.mean(relevant[: sum(relevant)]))
    return float(np.mean(nearest)), float(np.mean(tiers))


def histograms_by_loops(dataset):
    histograms = []
    for item in dataset:
        samples = item.signature.interior
        found = paper_histogram(samples.eigenfunctions, item.signature.eigenvalues)
        histograms.append(found.ravel())
    return np.array(histograms)


def chi_square(one, others):
    return np.sum((one - others) ** 2 / np.maximum(one + others, 1e-300), axis=1) / 2


def without_code(page):
    return re.sub(r"^```.*?^```", "", TEXT[page], flags=re.DOTALL | re.MULTILINE)


def extras():
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    return set(project["optional-dependencies"])


def test_readme_is_short_and_has_its_example():
    assert len(TEXT["README.md"].split()) <= 450
    assert len(python("README.md")) == 1


def test_the_twenty_lines_print_scores_and_the_nearest_and_train_a_layout(folder, capsys):
    example = python("README.md")[0].text
    (folder / "example.py").write_text(example)
    lines = [line for line in example.splitlines() if line and not line.startswith("#")]
    assert len(lines) <= 20
    made = runpy.run_path("example.py", run_name="__main__")
    assert made["loss"].item() < np.log(2)  # by chance
    start = igps.descriptor("interior", learnable=True).parameters()
    for before, after in zip(start, made["model"].descriptor.parameters(), strict=True):
        assert not np.allclose(before.tolist(), after.tolist(), rtol=0, atol=1e-3)
    scores, nearest = capsys.readouterr().out.splitlines()
    found = ast.literal_eval(scores)
    assert list(found) == SCORES
    dataset = SignatureDataset(folder / "shapes", cache_dir=folder / "cache")
    cells = histograms_by_loops(dataset)
    distances = np.array([chi_square(one, cells) for one in cells])
    labels = list(dataset.bodies.labels or ())
    assert (found["nn"], found["ft"]) == pytest.approx(first_tier(distances, labels))
    expected = [dataset.bodies.names[i] for i in np.argsort(distances[0], kind="stable")[:3]]
    assert ast.literal_eval(nearest) == expected
    assert expected[0] == dataset.bodies.names[0]


def runs_here(page):
    """Blocks with titles are the files of a package, which other tests install."""
    return page != "README.md" and any(block.title is None for block in python(page))


def refused(*_):
    raise AssertionError("a script that starts processes imports itself: n_workers=1, or __main__")


@pytest.mark.parametrize("page", [page for page in TEXT if runs_here(page)])
def test_the_code_of_a_page_runs_and_prints_what_the_page_shows(page, folder, capsys, monkeypatch):
    code, expected = program(page, folder)
    assert code
    if "MDAnalysis" in code:
        pytest.importorskip("MDAnalysis", reason="reads frames of simulations")
    (folder / "page.py").write_text(code)
    # Where it starts processes, they import it; entry points are read once in a process
    is_guarded = 'if __name__ == "__main__":' in code
    if is_guarded or any(folder.glob("*.dist-info")):
        (folder / "cache").unlink()
        printed = run_alone(folder, "page.py")
    else:
        monkeypatch.setattr("igps._parallel.WorkerPool", refused)
        runpy.run_path("page.py", run_name="__main__")
        printed = capsys.readouterr().out
    shown = iter(printed.splitlines())
    # In this order, others between
    missing = [line for line in expected.splitlines() if line not in shown]
    assert not missing, f"{page} shows {missing}, printed was\n{printed}"
    check = CHECKS.get(page)
    if check:
        check(printed, folder)


def check_retrieval(printed, folder):
    dataset = SignatureDataset(folder / "shapes", cache_dir=folder / "cache")
    cells = histograms_by_loops(dataset)
    labels = list(dataset.bodies.labels or ())
    bipeds = [i for i, label in enumerate(labels) if label == "biped"]
    rankings = []
    for i in bipeds:
        order = np.argsort(chi_square(cells[i], cells), kind="stable")
        rankings.append([labels[j] for j in order if j != i])
    tier = np.mean([ranking[:3].count("biped") / 3 for ranking in rankings])
    first = np.mean([ranking[0] == "biped" for ranking in rankings])
    assert ast.literal_eval(printed) == {"nn": round(100 * first), "ft": round(100 * tier)}


def check_classification(printed, folder):
    told = dict(line.split(": ", 1) for line in printed.splitlines() if ": " in line)
    paths = sorted((folder / "shapes").rglob("*.off"))
    cells = histograms_by_loops(SignatureDataset(paths, cache_dir=folder / "cache"))
    labels = np.array([path.parent.name for path in paths])
    from sklearn.metrics.pairwise import chi2_kernel
    from sklearn.model_selection import StratifiedKFold

    expected = []
    for train, test in StratifiedKFold(3, shuffle=True, random_state=0).split(cells, labels):
        machine = SVC().fit(np.sqrt(cells[train]), labels[train])
        expected.append(np.mean(machine.predict(np.sqrt(cells[test])) == labels[test]))
    folds = [float(word) for word in told["folds"].strip("[]").split()]
    np.testing.assert_allclose(folds, expected, atol=1e-6)
    assert min(expected) > 1 / 3  # by guessing
    chosen, score = told["chosen"].split()
    assert chosen in ("interior", "d2")
    # The first of the grid is this very pipeline
    assert float(score) >= round(float(np.mean(expected)), 2)
    assert told["predicted"] == labels[0]
    kernel = chi2_kernel(cells)
    expected_score = SVC(kernel="precomputed").fit(kernel, labels).score(kernel, labels)
    assert float(told["on what it was fitted to"]) == pytest.approx(expected_score)


def check_fine_tuning(printed, folder):
    scores, classified = printed.splitlines()
    assert ast.literal_eval(scores)["accuracy"] > 0.5  # by guessing: 0.25
    told = ast.literal_eval(classified.partition(": ")[2])
    paths = sorted((folder / "shapes").rglob("*.off"))[::6]
    assert sum(one == path.parent.name for one, path in zip(told, paths, strict=True)) >= 2
    assert (folder / "mine.safetensors").exists()


def check_anatomy(printed, folder):
    organs = [re.findall(r"s(\d)/\w+\.nii\.gz#(\w+)", line) for line in printed.splitlines()]
    assert len(organs) == len(list((folder / "segmentations").rglob("*.nii.gz"))) == 9
    for body, other in organs:
        assert body[0] != other[0]
        assert body[1] == other[1]


CHECKS = {
    "docs/how-to/retrieve.md": check_retrieval,
    "docs/how-to/classify.md": check_classification,
    "docs/how-to/fine-tune.md": check_fine_tuning,
    "docs/how-to/anatomy.md": check_anatomy,
}
"""What a page prints that is not printed in it: against another way to compute it, or against guessing."""


def shell_lines(page):
    """The commands of its shell blocks, and those within sentences."""
    text = "\n".join(block.text for block in blocks(page) if block.language == "sh")
    words = []
    for line in text.replace("\\\n", " ").splitlines():
        words += re.split(r";|&&|\|", line.split(" #")[0])
    words += re.findall(
        r"`((?:PYTHONPATH=\. )?(?:igps|make|python|pip) [^`]*)`", without_code(page)
    )
    return [line.strip() for line in words if line.strip() and not line.strip().startswith("#")]


def told(page):
    """What the shell is told on a page: each line, without settings for one command, and its words."""
    found = []
    for line in shell_lines(page):
        plain = re.sub(r"^([A-Z_]+=\S* )+", "", line)
        words = [word for word in shlex.split(plain) if not word.startswith(">")]
        found.append((plain, words))
    return found


def commands_told():
    """Of all pages what `igps` is told, by its command: its help takes half a second to make."""
    found = {}
    for page in TEXT:
        for line, words in told(page):
            name = command_of(words[1:]) if words[0] == "igps" else None
            if name is not None:  # of others the page's own test tells
                found.setdefault(name, []).append((line, words))
    return found


@pytest.mark.parametrize(("command", "lines"), commands_told().items())
def test_what_igps_is_told_exists(command, lines, capsys):
    with pytest.raises(SystemExit, match="0"):
        commands.run(*command.split(), "--help")
    text = capsys.readouterr().out
    shared = load_command(command).shared_options()
    for line, words in lines:
        for word in words:
            if word.startswith("--"):
                is_known = re.search(rf"{word}\b", text) or word.removeprefix("--") in shared
                assert is_known, f"{line}: no option {word}"


OTHER_PROGRAMS = {"git", "cd", "dask", "sbatch", "squeue", "eval", "source", "ssh", "rsync", "sudo"}


@pytest.mark.parametrize("page", [page for page in TEXT if shell_lines(page)])
def test_what_the_shell_is_told_exists(page):
    for line, words in told(page):
        match words[0]:
            case "make":
                wanted = [word for word in words[1:] if "=" not in word]
                makefile = (PROJECT / "Makefile").read_text()
                targets = re.findall(r"^([a-z0-9-]+):", makefile, flags=re.MULTILINE)
                assert wanted
                assert set(wanted) <= set(targets), line
            case "python":
                check_python(line, words)
            case "pip":
                assert words[1] == "install", line
                named = ",".join(re.findall(r"\[([^\]]+)\]", line))
                assert set(named.split(",")) <= extras() | {""}, line
            case "igps":
                assert words[1:] == ["--help"] or command_of(words[1:]), line
            case other:
                assert other in OTHER_PROGRAMS, line


def check_python(line, words):
    """The program exists, and has the options that it is given."""
    if "-m" in words:
        return
    script = next(word for word in words[1:] if not word.startswith("-"))
    source = (PROJECT / script).read_text()
    if "LightningCLI" not in source:
        for option in set(re.findall(r"--([a-z_]+)", line)) - {"config"}:
            assert re.search(rf"\b{option}\b|--{option}\b", source), f"{line}: no {option}"


def test_descriptors_and_commands_are_named():
    for name in NAMES:
        assert f"`{name}`" in TEXT["docs/index.md"], name
    every_page = "".join(TEXT.values())
    for name in extras() - {"test", "lint", "campaign", "docs"}:
        assert f"`{name}`" in TEXT["docs/index.md"] or f"[{name}]" in every_page, name


def anchors(text):
    """Ids of the headings, as GitHub and MkDocs make them of plain words."""
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", prose, flags=re.MULTILINE)
    plain = [re.sub(r"[^\w\- ]", "", heading).strip() for heading in headings]
    return {heading.lower().replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("name", re.findall(r"^::: (\S+)", TEXT["docs/api.md"], re.MULTILINE))
def test_the_reference_names_what_is_there(name):
    assert pydoc.locate(name) is not None, f"docs/api.md: nothing is called {name}"


@pytest.mark.parametrize("page", TEXT)
def test_links_lead_somewhere(page):
    here = PROJECT / page
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(page)):
        if target.startswith(("https://", "mailto:")):
            continue
        name, _, anchor = target.partition("#")
        path = (here.parent / name).resolve() if name else here
        assert path.exists(), f"{page}: {target}"
        if anchor:
            assert anchor in anchors(path.read_text(encoding="utf-8")), f"{page}: {target}"


@pytest.mark.parametrize("page", TEXT)
def test_tables_are_whole_and_prose_is_wrapped(page):
    """Each row of a table has as many cells as its head, and a rule below that; text has lines that can be read."""
    head, place = 0, 0
    for line in without_code(page).splitlines():
        if not line.startswith("|"):
            place = 0
            assert "{{" not in line, f"{page}: {line}"
            assert len(line) <= WIDTH, f"{page}: {line}"
            continue
        cells = len(re.findall(r"(?<!\\)\|", re.sub(r"`[^`]*`", "", line)))
        head = cells if place == 0 else head
        assert cells == head, f"{page}: {line}"
        is_rule = re.fullmatch(r"[|:\- ]+", line) is not None
        is_empty = line.strip("| ") == ""
        assert is_rule is (place == 1) or is_empty, f"{page}: {line}"
        place += 1


def table_rows(page, heading):
    """Of the first table that follows a heading, the rows by their first name in code, and their cells by column."""
    lines = without_code(page).splitlines()
    start = next(i for i in range(lines.index(heading), len(lines)) if lines[i].startswith("|"))
    columns = [cell.strip() for cell in lines[start].split("|")[1:-1]]
    rows = {}
    for line in lines[start + 2 :]:
        if not line.startswith("|"):
            break
        cells = [cell.strip(" *") for cell in line.split("|")[1:-1]]
        named = re.fullmatch(r"`(\w+)`", cells[0])
        if named:
            rows[named[1]] = dict(zip(columns, cells, strict=True))
    return rows


def test_the_figures_of_the_descriptors_are_those_that_were_measured():
    shown = table_rows("docs/index.md", "## Which descriptor")
    results = PROJECT / "docs" / "benchmarks" / "results" / "shrec07.json"
    measured = json.loads(results.read_text("utf-8"))
    rows = {}
    for row in measured["rows"]:
        rows[row[0].strip("`")] = dict(zip(measured["columns"], row, strict=True))
    assert set(shown) == {"interior", "gps", "multiscale", "rich", "pretrained"}
    for name, row in shown.items():
        for score in ("NN", "FT", "ST", "DCG"):
            assert row[score] == rows[name][score], name


def test_pictures_are_small():
    for path in (PROJECT / "docs").rglob("*.png"):
        assert path.stat().st_size < 400_000, path
