"""The example of the page *Add a descriptor*, as another package would install it."""

import re
import tomllib
from pathlib import Path

import pytest

import igps
from igps.signature.signature import SignatureConfig

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "add-descriptor.md"


def file_of_the_page(name):
    """The text of the block whose title is this file."""
    pattern = rf'^```\w+ title="{re.escape(name)}"\n(.*?)^```'
    match = re.search(pattern, PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert match is not None
    return match[1]


@pytest.fixture
def installed(on_path):
    """The package of the page, laid out on the Python path as pip would do it."""
    project = tomllib.loads(file_of_the_page("pyproject.toml"))["project"]
    (on_path / "mine.py").write_text(file_of_the_page("mine.py"))
    info = on_path / f"{project['name']}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    lines = []
    for group, places in project["entry-points"].items():
        lines.append(f"[{group}]")
        lines += [f"{name} = {place}" for name, place in places.items()]
    (info / "entry_points.txt").write_text("\n".join(lines))


def test_the_example_is_short():
    text = file_of_the_page("mine.py") + file_of_the_page("pyproject.toml")
    assert len(text.splitlines()) <= 30


def test_an_installed_descriptor_is_known_by_its_name(installed, blob):
    config = SignatureConfig(n_eigenpairs=5, resolution=6, min_samples=0, n_surface_samples=50)
    batch = igps.collate([igps.compute_signature(blob, config)])
    roundness = igps.descriptor("roundness")
    assert not roundness.training
    expected = pytest.approx(blob.volume / blob.area**1.5)
    assert roundness(batch).item() == expected


def test_a_wrong_name_lists_installed_descriptors_too(installed):
    with pytest.raises(ValueError, match=r"expected one of interior, .*, roundness, or package"):
        igps.descriptor("round")


def test_a_name_of_the_library_stays_its_own(on_path):
    info = on_path / "other-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[igps.descriptors]\nd2 = math:pi\n")
    assert igps.descriptor("d2").name == "d2"
