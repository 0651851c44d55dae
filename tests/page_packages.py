"""Packages of one's own that pages of the documentation show, laid out as pip would do it."""

import re
import tomllib
from pathlib import Path

HOW_TO = Path(__file__).parents[1] / "docs" / "how-to"


def files_of_page(page):
    """The text of each block of a page that has the name of a file as its title."""
    text = (HOW_TO / page).read_text(encoding="utf-8")
    blocks = re.findall(r'^```\w+ title="([^"]+)"\n(.*?)^```', text, re.DOTALL | re.MULTILINE)
    return dict(blocks)


def install_page(page, folder):
    """Write the files of a page and make its entry points known to programs that have the folder on their path."""
    files = files_of_page(page)
    install(files.pop("pyproject.toml"), folder)
    for name, text in files.items():
        (folder / name).write_text(text)


def install(pyproject, folder):
    """Make the entry points of a package known."""
    project = tomllib.loads(pyproject)["project"]
    information = folder / f"{project['name']}-{project['version']}.dist-info"
    information.mkdir()
    head = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    (information / "METADATA").write_text(head)
    lines = []
    for group, entries in project["entry-points"].items():
        lines.append(f"[{group}]")
        lines += [f"{name} = {place}" for name, place in entries.items()]
    (information / "entry_points.txt").write_text("\n".join(lines))
