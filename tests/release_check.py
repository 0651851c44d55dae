"""Install wheel and source archive into empty environments, and try them there: python tests/release_check.py

Once with the lowest versions of all dependencies that pyproject.toml allows, once with the newest. It needs an index of
packages and minutes, and is no part of the tests; `tests/test_distribution.py` is the quick form.
"""

import re
import subprocess
import sys
import tempfile
import tomllib
import venv
from pathlib import Path

PROJECT = Path(__file__).parents[1]


def lowest(requirements):
    """Constraints that pin each requirement to the lowest version it allows."""
    found = []
    for requirement in requirements:
        name, least = re.match(r"([\w.-]+)(?:\[[\w,-]+\])?.*?>=\s*([\w.]+)", requirement).groups()
        found.append(f"{name}=={least}")
    return found


def main():
    """Build, install, try; the first command that fails ends it."""
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        build = [sys.executable, "-m", "build", "--outdir", folder / "dist", PROJECT]
        subprocess.run(build, check=True)
        (wheel,) = (folder / "dist").glob("*.whl")
        (source,) = (folder / "dist").glob("*.tar.gz")
        # Lightning needs a setuptools that still has pkg_resources in its lowest versions
        pins = {"lowest": [*lowest(project["dependencies"]), "setuptools<81"], "newest": []}
        for (which, constraints), archive in zip(
            pins.items(),
            (wheel, source),
            strict=True,
        ):
            place = folder / which
            venv.create(place, with_pip=True)
            python = str(place / "bin" / "python")
            (folder / "constraints.txt").write_text("\n".join(constraints))
            command = [python, "-m", "pip", "install", "--quiet", "--constraint"]
            command += [folder / "constraints.txt", archive]
            if which == "lowest":
                command.append("setuptools<81")
            subprocess.run(command, check=True)
            smoke = [python, PROJECT / "tests" / "smoke.py", project["version"], place]
            subprocess.run(smoke, check=True, cwd=folder)
            print(f"{which} versions, {archive.name}: works")


if __name__ == "__main__":
    main()
