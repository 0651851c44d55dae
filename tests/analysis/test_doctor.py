"""What `examine` says of files that were damaged by hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from damaged_files import (
    N_FACES,
    N_VERTICES,
    free_edges,
    without_collada,
    write_box,
    write_clean,
    write_crossing,
    write_holed,
    write_soup,
    write_unusable,
)
from igps._parallel import Limits
from igps.analysis.doctor import Finding, examine, expected_cost, usable
from igps.data.sources import find_bodies
from igps.mesh.options import LoadOptions
from igps.signature.signature import SignatureConfig

CONFIG = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=60)


def findings(root: Path, **options) -> dict[str, Finding]:  # type: ignore[no-untyped-def]
    files = find_bodies(root)
    found = examine(files, config=CONFIG, n_workers=1, progress=False, **options)
    assert tuple(finding.id for finding in found) == files.names
    return {finding.id: finding for finding in found}


def test_each_fault_and_what_will_be_done(tmp_path: Path) -> None:
    write_clean(tmp_path / "clean.off")
    soup, holed = write_soup(tmp_path / "soup.off"), write_holed(tmp_path / "holed.off")
    write_box(tmp_path / "box.off")
    write_crossing(tmp_path / "crossing.off")
    found = findings(tmp_path)
    assert usable(list(found.values()))
    clean = found["clean.off"]
    assert (clean.fault, clean.steps, clean.notes, clean.error) == (None, (), (), None)
    assert clean.n_vertices == clean.n_vertices_after == N_VERTICES

    assert found["soup.off"].steps == ("welded",)
    assert found["soup.off"].notes == (f"welded {3 * N_FACES - N_VERTICES} coincident vertices",)
    assert (found["soup.off"].n_vertices, found["soup.off"].n_vertices_after) == (3 * N_FACES, N_VERTICES)
    assert f"{free_edges(soup)} boundary edges" in str(found["soup.off"].fault)

    assert found["holed.off"].steps == ("filled",)
    assert found["holed.off"].notes == ("filled 1 small holes",)
    assert found["holed.off"].n_vertices == N_VERTICES - 1
    assert f"{free_edges(holed)} boundary edges" in str(found["holed.off"].fault)
    assert free_edges(holed) == 6

    # Eight vertices are a body, but not for twenty eigenpairs.
    assert found["box.off"].fault is None
    assert found["box.off"].steps == ("subdivided",)
    assert found["box.off"].n_vertices == 8
    assert (found["box.off"].n_vertices_after or 0) >= 22

    assert "2 connected components" in str(found["crossing.off"].fault)
    assert found["crossing.off"].steps[0] == "united"


def test_what_cannot_be_used_costs_the_others_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    without_collada(monkeypatch)
    write_clean(tmp_path / "clean.off")
    sentences = write_unusable(tmp_path)
    found = findings(tmp_path)
    assert {name: one.error for name, one in found.items()} == {
        "clean.off": None,
        **{name: f"{tmp_path / name}: {sentence}" for name, sentence in sentences.items()},
    }
    assert not usable(list(found.values()))
    assert all(found[name].seconds is None and found[name].n_vertices_after is None for name in sentences)
    # Some can be read at least.
    assert {name: found[name].n_vertices for name in ("triangle.off", "line.obj", "five.xyz", "empty.off")} == {
        "triangle.off": 3, "line.obj": 4, "five.xyz": 5, "empty.off": None,
    }  # fmt: skip


def test_the_reading_decides(tmp_path: Path) -> None:
    holed = write_holed(tmp_path / "holed.off")
    never = findings(tmp_path, reading=LoadOptions("never"))["holed.off"]
    assert never.error == never.fault
    assert str(never.error).startswith(f"{holed}: open surface with 6 boundary edges")
    always = findings(tmp_path, reading=LoadOptions("always"))["holed.off"]
    assert always.steps == ("watertight",)
    assert always.fault == never.fault
    allowed = findings(tmp_path, reading=LoadOptions("never", allow_open=True))["holed.off"]
    assert (allowed.fault, allowed.error, allowed.steps) == (None, None, ())


def test_a_file_that_takes_too_long_is_told(tmp_path: Path) -> None:
    write_clean(tmp_path / "clean.off")
    found = findings(tmp_path, limits=Limits(seconds=1e-6))["clean.off"]
    assert "time_limit" in str(found.error)


def test_the_cost_grows_with_vertices_and_eigenpairs() -> None:
    costs = [expected_cost(n, k) for k in (50, 250) for n in (1_000, 10_000, 100_000)]
    for few, many in zip(costs[:3], costs[3:], strict=True):
        assert all(a < b for a, b in zip(few, many, strict=True))
    for part in (0, 1):
        assert costs[0][part] < costs[1][part] < costs[2][part]


def test_the_cost_is_that_of_the_mesh_that_is_simplified(tmp_path: Path) -> None:
    write_clean(tmp_path / "clean.off")
    files = find_bodies(tmp_path)
    (full,) = examine(files, config=CONFIG, n_workers=1, progress=False)
    fewer = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=60, max_vertices=60)
    (simplified,) = examine(files, config=fewer, n_workers=1, progress=False)
    assert full.memory == expected_cost(N_VERTICES, 20)[1]
    assert simplified.memory == expected_cost(60, 20)[1]
