"""The example of the page *Add a command*, as another package would install it."""

import json
import re

import pytest

from commands import error_of, run
from igps.mesh.loading import load_mesh
from own_descriptors import write_egg
from page_packages import files_of_page, install_page

PAGE = "add-command.md"


@pytest.fixture
def installed(on_path):
    """The package of the page, laid out on the Python path as pip would do it."""
    install_page(PAGE, on_path)


def test_the_example_is_short():
    text = "".join(files_of_page(PAGE).values())
    assert len(text.splitlines()) <= 30


def test_an_installed_command_runs_with_the_options_of_reading(installed, tmp_path, capsys):
    for name, height in (("flat", 0.5), ("long", 2.0)):
        write_egg(tmp_path / "eggs" / f"{name}.off", height, subdivisions=2)
    options = ["--least", 3, "--cache_dir", tmp_path / "cache", "--n_workers", 1]
    options += ["--signature.n_eigenpairs", 20, "--signature.resolution", 8, "--json"]
    run("volumes", tmp_path / "eggs", *options)
    printed = capsys.readouterr()
    expected = load_mesh(tmp_path / "eggs" / "long.off").volume
    assert json.loads(printed.out) == {"long.off": pytest.approx(expected, rel=1e-6)}
    assert "long.off" in printed.err
    words = error_of(capsys, "volumes", tmp_path / "none", *options)
    assert "no such folder" in words


def test_help_lists_an_installed_command(installed, capsys):
    with pytest.raises(SystemExit, match="0"):
        run("--help")
    assert re.search(r"volumes +from volumes", capsys.readouterr().out)
    with pytest.raises(SystemExit, match="0"):
        run("volumes", "--help")
    text = " ".join(capsys.readouterr().out.split())
    assert "leave out smaller bodies (default: 0.0)" in text
    assert "--mend {auto,never,always}" in text
