"""What takes long shows a bar on standard error, with the time left, and leaves standard output to the results."""

import re

import pytest

from commands import run
from own_descriptors import SMALL, write_egg

INTERIOR = "own_descriptors:small_interior"
# Such as "1/3 signatures: 4/4 [00:03<00:00]": the step, how many of how many, time taken and left
BAR = re.compile(
    r"^(?:\d/\d )?([\w -]+): (\d+)/(\d+) \[\d\d:\d\d<(?:\d\d:\d\d|\?)\]$", re.MULTILINE
)


@pytest.fixture
def root(tmp_path):
    """Two balls and two long eggs."""
    for label, heights in (("ball", (1.0, 1.1)), ("egg", (2.2, 2.4))):
        for i, height in enumerate(heights):
            write_egg(tmp_path / "meshes" / label / f"{i}.off", height, subdivisions=2)
    return tmp_path / "meshes"


def bars(text):
    """Of the longest bar of each name, where it stood last and where it ends."""
    found = {}
    for name, done, total in BAR.findall(text):
        if int(total) >= found.get(name.strip(), (0, 0))[1]:
            found[name.strip()] = (int(done), int(total))
    return found


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        (
            "retrieve ROOT --descriptor INTERIOR --out OUT --rerank --report SMALL",
            {
                "signatures": 4,
                "descriptions": 4,
                "distances by interior": 4,
                "rankings": 4,
                "pictures": 4,
            },
        ),
        (
            "compare ROOT --descriptors INTERIOR SMALL",
            {"signatures": 4, "descriptions": 4, "distances by interior": 4},
        ),
        (
            "extract ROOT --out OUT.npz --descriptor INTERIOR SMALL",
            {"signatures": 4, "descriptions": 4},
        ),
        (
            "query MESH --gallery ROOT --descriptor INTERIOR SMALL",
            {"signatures": 4, "descriptions": 4},
        ),
        ("precompute ROOT --descriptors INTERIOR SMALL", {"signatures": 4}),
        (
            "gallery build ROOT --out OUT.igps --descriptor INTERIOR SMALL",
            {"signatures": 4, "descriptions": 4},
        ),
        ("doctor ROOT --n_workers 1", {"bodies": 4}),
        ("explain MESH OTHER --n_workers 1", {"signatures": 2, "descriptions": 2}),
        ("duplicates ROOT --n_workers 1", {"signatures": 4, "surfaces": 4, "compared": 4}),
    ],
    ids=lambda value: value.split(" ROOT")[0].split(" MESH")[0] if isinstance(value, str) else "",
)
def test_a_bar_tells_how_far_it_is_and_what_time_is_left(command, expected, root, tmp_path, capsys):
    """The bars have the names, and the ends that the number of files sets, and they reach them."""
    words = {
        "ROOT": str(root),
        "MESH": str(root / "egg" / "0.off"),
        "OTHER": str(root / "ball" / "1.off"),
        "INTERIOR": INTERIOR,
        "SMALL": " ".join(SMALL),
        "OUT": str(tmp_path / "out"),
    }
    line = re.sub(
        r"\b(ROOT|MESH|OTHER|INTERIOR|SMALL|OUT)\b", lambda match: words[match[0]], command
    )
    reads_signatures = not command.startswith("doctor")
    cache = ["--cache_dir", str(tmp_path / "cache")] if reads_signatures else []
    run(*line.split(), *cache)
    printed = capsys.readouterr()
    shown = bars(printed.err)
    assert {name for name in expected if name not in shown} == set(), printed.err
    for done, total in shown.values():
        assert done == total
    assert {name: shown[name][1] for name, total in expected.items() if total is not None} == {
        name: total for name, total in expected.items() if total is not None
    }
    assert not bars(printed.out)


@pytest.mark.parametrize(
    ("command", "n_steps"),
    [
        ("retrieve ROOT --descriptor INTERIOR SMALL", 3),
        ("retrieve ROOT --descriptor INTERIOR SMALL --out OUT --report", 5),
        ("extract ROOT --out OUT.csv --descriptor INTERIOR SMALL", 2),
        ("compare ROOT --descriptors INTERIOR SMALL", 3),
        ("query MESH --gallery ROOT --descriptor INTERIOR SMALL", 4),
        ("fit ROOT --out OUT.safetensors --descriptor INTERIOR SMALL", 2),
        ("clusters ROOT --descriptor INTERIOR SMALL --out OUT", 3),
        ("gallery build ROOT --out OUT.igps --descriptor INTERIOR SMALL", 2),
    ],
)
def test_bars_are_numbered_by_the_steps_of_the_command(command, n_steps, root, tmp_path, capsys):
    words = {"ROOT": root, "MESH": root / "egg" / "0.off", "INTERIOR": INTERIOR}
    words |= {"SMALL": " ".join(SMALL), "OUT": tmp_path / "out"}
    for word, value in words.items():
        command = re.sub(rf"\b{word}\b", str(value), command)
    run(*command.split(), "--cache_dir", str(tmp_path / "cache"), "--n_workers", "1")
    numbers = re.findall(r"^(\d)/(\d) [a-z]", capsys.readouterr().err, re.MULTILINE)
    assert sorted(set(numbers)) == [(str(i + 1), str(n_steps)) for i in range(n_steps)]
