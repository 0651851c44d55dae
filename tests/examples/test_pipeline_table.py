"""Each line of the table of pipelines does what its page says."""

import contextlib
import os
import re
from pathlib import Path

import pytest
import torch

PAGE = (Path(__file__).parents[2] / "docs" / "how-to" / "pipelines.md").read_text(encoding="utf-8")
ROWS = {
    int(n): (what, code)
    for n, what, code in re.findall(r"^\| (\d+) \| (.*?) \| `(.*)` \|$", PAGE, re.MULTILINE)
}
CHECKS = {
    1: lambda found, space: found[0] == 0 and found[1].name == "biped/00.off",
    2: lambda found, space: [len(one) for one in found] == [3, 3],
    3: lambda found, space: found[0].tolist() == [0, 0, 0, 1, 1, 1] and found[1][0] == "biped",
    5: lambda found, space: len(found[0].signature.interior) == 300,
    6: lambda found, space: [len(one) for one in found] == [4, 2],
    7: lambda found, space: sorted(i for one in found for i in one) == list(range(6)),
    8: lambda found, space: len(list(found)) == 6,
    9: lambda found, space: (
        sorted(one.id for one in found) == sorted(space["dataset"].bodies.names)
    ),
    10: lambda found, space: found[3].id == space["dataset"][3].id,
    11: lambda found, space: found[1].ids == space["batch"].ids,
    12: lambda found, space: len(found) == 8 and found.ids[6:] == space["batch"].ids[:2],
    13: lambda found, space: tuple(found.shape) == (6, 2) and found.requires_grad,
    14: lambda found, space: torch.allclose(
        found.sum(dim=1),
        torch.ones(6),
    ),
    15: lambda found, space: not found.missing_keys,
    16: lambda found, space: bool((found.diagonal() == 0).all() and (found[:3, 3:] > 0).all()),
    17: lambda found, space: torch.allclose(
        found,
        space["descriptor"](space["batch"]),
        atol=1e-6,
    ),
    18: lambda found, space: torch.allclose(
        found[1].float(), space["descriptor"](space["batch"]), atol=1e-4
    ),
    20: lambda found, space: found.argmax(dim=1).tolist() == [0, 0, 0, 1, 1, 1],
    21: lambda found, space: next(iter(found)).y.tolist() == space["dataset"].targets,
    22: lambda found, space: torch.equal(
        found[1](space["batch"]), space["descriptor"](space["batch"])
    ),
    23: lambda found, space: torch.equal(
        found[1](space["batch"]), space["descriptor"](space["batch"])
    ),
    24: lambda found, space: (
        found.is_meta and found.shape == space["descriptor"](space["batch"]).shape
    ),
}
NOTHING_COMES_BACK = {19}


@pytest.fixture(scope="module")
def space(tmp_path_factory):
    """What the page's own lines define, in a folder of their own."""
    match = re.search(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    assert match is not None
    found = {}
    here = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("pipelines"))
    try:
        exec(compile(match[1], "pipelines.md", "exec"), found)
        found["folder"] = Path.cwd()
    finally:
        os.chdir(here)
    return found


@pytest.fixture
def in_folder(space):
    """The folder of the page as the current one."""
    with contextlib.chdir(space["folder"]):
        yield


def test_there_are_twenty_things_that_work_and_reasons_for_the_rest():
    assert len(ROWS) >= 20
    numbers = [
        int(n)
        for n in re.findall(
            r"^\| (\d+) \|",
            PAGE,
            re.MULTILINE,
        )
    ]
    assert numbers == list(range(1, 29))
    rest = [line for line in PAGE.splitlines() if line.startswith(("| 25", "| 26", "| 27", "| 28"))]
    for line in rest:
        assert ": " in line or "where" in line


@pytest.mark.usefixtures("in_folder")
@pytest.mark.parametrize("number", [number for number in ROWS if number != 4])
def test_a_line_of_the_table_works(space, number, monkeypatch):
    monkeypatch.setattr("igps.data.dataset.default_cache_dir", lambda: space["folder"] / "cache")
    torch.compiler.reset()
    torch.manual_seed(0)
    found = eval(ROWS[number][1], space)
    if number in NOTHING_COMES_BACK:
        assert found is None
    else:
        assert CHECKS[number](found, space), ROWS[number][0]


@pytest.mark.usefixtures("in_folder")
def test_a_transform_is_set_and_taken_away(space):
    dataset = space["dataset"]
    whole = len(dataset[0].signature.interior)
    exec(ROWS[4][1], space)
    assert len(dataset[0].signature.interior) == 300 < whole
    dataset.transform = None
    assert len(dataset[0].signature.interior) == whole
