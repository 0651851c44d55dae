"""The lines of the README that compare, with descriptors of each kind in place of the one that is printed there."""

import ast
import contextlib
import re
from pathlib import Path

import pytest

import igps

README = Path(__file__).parents[2] / "README.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two classes of three small shapes, and a cache of their signatures with all that any descriptor needs."""
    root = tmp_path_factory.mktemp("ten_lines")
    igps.ArticulatedShapes(n_classes=2, n_per_class=3, n_vertices=1100).write(root / "shapes")
    for name in ("rich", "interior"):
        dataset = igps.SignatureDataset(
            root / "shapes", cache_dir=root / "cache", descriptor=igps.descriptor(name)
        )
        assert dataset.precompute(n_workers=1, progress=False) == []
    return root


@pytest.mark.parametrize("name", ["pretrained", "d2", "measures"])
def test_the_ten_lines_work_with_descriptors_of_each_kind(folder, name, capsys):
    match = re.search(
        r"^```python\n(.*?)^```", README.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
    )
    assert match is not None
    # The shapes are there
    comparison = match[1].partition("\n#")[0]
    lines = [line for line in comparison.splitlines() if ".write(" not in line]
    example = "\n".join(lines).replace('"interior"', repr(name))
    assert repr(name) in example
    with contextlib.chdir(folder):
        exec(compile(example, str(README), "exec"), {})
    scores, nearest = capsys.readouterr().out.splitlines()
    assert ast.literal_eval(scores)["nn"] >= 0.5  # by chance 0.4
    first, second, third = ast.literal_eval(nearest)
    assert first.endswith("0.off")
    assert len({first, second, third}) == 3
