"""Wheel and source archive are built, hold what they must, and work where they are installed."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

PROJECT = Path(__file__).parents[1]
VERSION = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]["version"]
SMOKE = PROJECT / "tests" / "smoke.py"


@pytest.fixture(scope="module")
def archives(tmp_path_factory):
    """Wheel and source archive; the former made of the latter, as an installation from source would."""
    for module in ("build", "setuptools"):
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"needs {module}")
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(PROJECT)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if "ERROR Missing dependencies" in done.stdout + done.stderr:
        pytest.skip("needs the build backend that pyproject.toml asks for")
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = out.glob("*.whl")
    (source,) = out.glob("*.tar.gz")
    return wheel, source


def test_archives_hold_what_the_package_needs(archives):
    wheel, source = archives
    package = PROJECT / "src" / "igps"
    wanted = {path.relative_to(package.parent).as_posix() for path in package.rglob("*.py")}
    wanted |= {"igps/py.typed", "igps/report/template/page.html.j2"}
    wanted |= {"igps/descriptors/pretrained/pretrained.safetensors", "igps/learning/train.yaml"}
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert wanted <= names
    assert not [name for name in names if name.startswith(("tests/", "training/", "docs/"))]
    with tarfile.open(source) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "README.md", "LICENSE"} <= inside
    assert {f"src/{name}" for name in wanted} <= inside


def borrow_compiled_loops(installed):
    """Give a package the loops that are compiled in this tree, which Numba takes if the times of their files agree."""
    package = PROJECT / "src" / "igps"
    for path in package.rglob("*.py"):
        copy = installed / path.relative_to(package)
        assert copy.read_bytes() == path.read_bytes()
        time = path.stat().st_mtime_ns
        os.utime(copy, ns=(time, time))
    for path in package.rglob("*.nb[ic]"):
        copy = installed / path.relative_to(package)
        copy.parent.mkdir(exist_ok=True)
        shutil.copy(path, copy)


def test_the_installed_wheel_works(archives, tmp_path):
    """In an environment of its own, without this tree; what it depends on is borrowed from the one of the tests."""
    venv.create(tmp_path / "venv", with_pip=False)
    python = tmp_path / "venv" / "bin" / "python"
    if not python.exists():
        pytest.skip("knows only the layout of environments on Unix")
    (there,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    command += ["--no-build-isolation", "--target", str(there), str(archives[0])]
    subprocess.run(command, check=True)
    borrow_compiled_loops(there / "igps")
    borrowed = [path for path in sys.path if path.endswith("site-packages")]
    # Only their modules: pth files, such as that of an editable install of this very tree, are not read
    environment = {"PYTHONPATH": ":".join([str(there), *borrowed]), "PATH": "/usr/bin:/bin"}
    environment["OMP_NUM_THREADS"] = "1"
    command = [str(python), str(SMOKE), VERSION, str(there)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "works"


def test_the_version_is_the_same_everywhere():
    citation = (PROJECT / "CITATION.cff").read_text()
    assert re.search(r"^version: (.*)$", citation, flags=re.MULTILINE).group(1) == VERSION
    newest = re.search(r"^## (.*)$", (PROJECT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    assert newest is not None
    assert newest.group(1) == VERSION


def test_the_citation_has_the_address_that_the_package_names():
    urls = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]["urls"]
    doi = re.search(r"^    doi: (.*)$", (PROJECT / "CITATION.cff").read_text(), flags=re.MULTILINE)
    assert doi is not None
    assert f"https://doi.org/{doi.group(1)}" in urls.values()
