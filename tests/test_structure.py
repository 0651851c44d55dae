"""The imports run one way: geometry → data → nn → baselines → the command line; retrieval stands apart."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import igps

PACKAGE = Path(igps.__file__).parent
MAY_IMPORT = {
    "geometry": {"geometry"},
    "data": {"geometry", "data"},
    "nn": {"geometry", "data", "nn", "retrieval"},
    "retrieval": {"retrieval"},
    "baselines": {"geometry", "data", "nn", "retrieval", "baselines"},
}


def imported_rooms(path: Path) -> set[str]:
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        rooms |= {name.split(".")[1] for name in names if name.startswith("igps.")}
    return rooms


@pytest.mark.parametrize("room", sorted(MAY_IMPORT))
def test_imports_run_one_way(room: str) -> None:
    files = sorted((PACKAGE / room).rglob("*.py"))
    assert files
    for file in files:
        assert imported_rooms(file) <= MAY_IMPORT[room], file


def test_only_the_command_line_imports_baselines() -> None:
    importing = {
        file.relative_to(PACKAGE).parts[0] for file in PACKAGE.rglob("*.py") if "baselines" in imported_rooms(file)
    }
    assert importing == {"baselines", "cli"}


def test_front_door_opens() -> None:
    assert len(set(igps.__all__)) == len(igps.__all__)
    for name in igps.__all__:
        assert hasattr(igps, name), name
