"""The imports run one way: each room uses only the floors below its own; the lowest two know nothing of igps."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import igps

PACKAGE = Path(igps.__file__).parent
# From the ground up. A room imports only from the floors below its own, and itself; a new room is one more name here.
FLOORS = (
    ("linalg", "retrieval"),
    ("geometry",),
    ("shapes",),
    ("data",),
    ("nn",),
    ("baselines",),
    ("figures",),
    ("cli",),
)


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


@pytest.mark.parametrize(("floor", "room"), [(floor, room) for floor, rooms in enumerate(FLOORS) for room in rooms])
def test_imports_run_one_way(floor: int, room: str) -> None:
    below = {name for rooms in FLOORS[:floor] for name in rooms}
    files = sorted((PACKAGE / room).rglob("*.py"))
    assert files
    for file in files:
        assert imported_rooms(file) <= {room} | below, file


def test_every_room_has_its_floor() -> None:
    rooms = {file.parent.name for file in PACKAGE.glob("*/__init__.py")}
    assert rooms == {room for rooms in FLOORS for room in rooms}


def test_only_the_command_line_imports_baselines() -> None:
    importing = {
        file.relative_to(PACKAGE).parts[0] for file in PACKAGE.rglob("*.py") if "baselines" in imported_rooms(file)
    }
    assert importing == {"baselines", "cli"}


def test_front_door_opens() -> None:
    assert len(set(igps.__all__)) == len(igps.__all__)
    for name in igps.__all__:
        assert hasattr(igps, name), name
