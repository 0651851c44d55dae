"""The commands and their options: few, told in their help, and known before anything heavy is imported."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

import igps
from commands import error_of, run
from igps.cli.commands import COMMANDS, load_command
from igps.cli.parsing import parse
from igps.cli.shared_options import COMMON, SHARED
from igps.mesh.options import LoadOptions
from igps.signature.config import SignatureConfig

HEAVY = (
    "torch",
    "numpy",
    "scipy",
    "numba",
    "trimesh",
    "pytorch_lightning",
    "sklearn",
    "matplotlib",
)
SOURCE = Path(igps.__file__).parents[1]


NO_WORKERS = "import igps._workers; igps._workers.Worker = None"


def igps_with(*words: str, code: str = "") -> subprocess.CompletedProcess[str]:
    """Run `igps` in a process of its own, and print at its end which heavy modules it has imported."""
    told = f"print('HEAVY', [name for name in {HEAVY!r} if name in sys.modules])"
    lines = [
        "import atexit, sys",
        f"atexit.register(lambda: {told})",
        f"sys.argv = {['igps', *words]!r}",
        code,
        "from igps.cli import main",
        "main()",
    ]
    command = [sys.executable, "-c", "\n".join(lines)]
    environment = {**os.environ, "PYTHONPATH": str(SOURCE)}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)


def test_a_cached_folder_is_queried_without_compiled_loops_and_without_workers(
    tmp_path: Path,
) -> None:
    shapes = tmp_path / "shapes"
    igps.ArticulatedShapes(n_classes=2, n_per_class=2, n_vertices=500).write(shapes)
    first = next(shapes.rglob("*.off"))
    words = ("query", str(first), "--gallery", str(shapes), "--cache_dir", str(tmp_path / "cache"))
    run(*words)
    done = igps_with(*words, code=NO_WORKERS)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "HEAVY ['torch', 'numpy', 'scipy']"


@pytest.mark.parametrize(
    ("words", "status"),
    [
        (["--help"], 0),
        (["--version"], 0),
        (["help", "options"], 0),
        (["gallery", "--help"], 0),
        *[([*name.split(), "--help"], 0) for name in COMMANDS],
        (["--wrong"], 2),
        (["retreive", "folder"], 2),
        (["gallery", "built"], 2),
        (["retrieve", "folder", "--wrong"], 2),
        (["retrieve", "folder", "--mend", "perhaps"], 2),
        (["retrieve", "folder", "--signature.resolution", "fine"], 2),
        (["retrieve"], 2),
    ],
)
def test_help_and_wrong_words_are_answered_without_heavy_imports(
    words: list[str], status: int
) -> None:
    done = igps_with(*words)
    assert done.stdout.splitlines()[-1] == "HEAVY []", done.stderr
    assert done.returncode == status
    assert "Traceback" not in done.stderr
    if status:
        assert "igps" in done.stderr.splitlines()[-1]


def test_there_are_few_commands_and_few_options() -> None:
    """The shared options that few people use count once.

    One of them, `train`, is the only way to train by gradients without a clone of the project.
    """
    n_options = sum(name not in COMMON for name in SHARED)
    for name in COMMANDS:
        command = load_command(name)
        shared = command.shared_options()
        n_options += len(command.own_options()) + len(shared.keys() & {*COMMON}) + bool(shared)
    assert len(COMMANDS) <= 24  # each answers a question that no other does
    assert n_options <= 330


def test_every_field_of_the_options_is_an_option() -> None:
    names = {field.name for field in fields(LoadOptions)}
    names |= {f"signature.{field.name}" for field in fields(SignatureConfig)}
    assert names <= set(SHARED)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_has_help_and_no_python(name: str) -> None:
    command = load_command(name)
    assert command.summary.endswith(".")
    for option, _ in command.own_options():
        assert option.help, option.name
        for word in ("None", "null", "see `", "Literal"):
            assert word not in option.help, option.name


def test_the_help_of_a_command_has_its_options_and_those_that_people_use(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit, match="0"):
        run("gallery", "build", "--help")
    text = " ".join(capsys.readouterr().out.split())
    assert text.startswith("usage: igps gallery build root --out OUT [options] ")
    for words in ("--descriptor", "--bodies {whole,labels,objects", "--cache_dir", "--options"):
        assert words in text
    assert "--signature" not in text
    with pytest.raises(SystemExit, match="2"):
        run("gallery", "build")
    assert "required: root, --out" in capsys.readouterr().err
    run("help", "options")
    text = " ".join(capsys.readouterr().out.split())
    for words in (
        "--signature.seed SEED",
        "--threshold THRESHOLD",
        "never refines it (default: 1000)",
    ):
        assert words in text
    run("help", "descriptors")
    assert "pretrained" in capsys.readouterr().out.split()


def test_rare_options_may_be_typed_or_stand_in_a_file(tmp_path: Path) -> None:
    file = tmp_path / "options.yaml"
    file.write_text("mend: always\nstrict: true\nsignature:\n  resolution: 20\n  accuracy: none\n")
    _, options = parse(["retrieve", "--threshold", "0.3", "folder", "--options", str(file)])
    config = SignatureConfig(resolution=20, accuracy=None)
    expected = {"root": Path("folder"), "threshold": 0.3, "mend": "always", "strict": True}
    assert options == {**expected, "signature": config}
    typed = ["--signature.resolution=30", "--mend", "never", "--options", str(file)]
    _, options = parse(["retrieve", "folder", *typed])
    assert options["signature"] == SignatureConfig(resolution=30, accuracy=None)
    assert options["mend"] == "never"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mended: always", "options: .* has 'mended', which this command does not have"),
        ("- mend", "options: expected lines such as `mend: always`"),
        ("mend: [", "options: .* is not YAML"),
    ],
)
def test_a_wrong_file_of_options_is_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "options.yaml").write_text(text)
    with pytest.raises(ValueError, match=message):
        parse(["retrieve", "folder", "--options", str(tmp_path / "options.yaml")])


@pytest.mark.parametrize("command", ["compare", "precompute"])
def test_a_repeated_list_is_collected_in_place_of_its_default(command: str) -> None:
    words = ["--descriptors", "pretrained", "--descriptors", "d2", "rich"]
    for _ in range(2):
        _, options = parse([command, "root", *words])
        assert options["descriptors"] == ["pretrained", "d2", "rich"]
    _, options = parse(["groups", "root", "--with", "a", "--with", "b=2"])
    assert options["with"] == ["a", "b=2"]


def test_a_function_is_a_command(own_commands, capsys):
    run("pose", "a.off", "--classes", "1", "2", "--exact")
    run("pose", "a.off", "--length", "3")
    assert capsys.readouterr().out.splitlines() == ["a.off [1, 2] True 2.0", "a.off None False 3.0"]
    with pytest.raises(SystemExit, match="0"):
        run("pose", "--help")
    text = capsys.readouterr().out
    assert all(words in text for words in ("what to draw", "which to show", "(default: 2.0)"))


def test_options_that_contradict_each_other_are_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    words = ["doctor", tmp_path, "--mend", "always", "--allow_open"]
    assert "allow_open: expected" in error_of(capsys, *words)


def test_nobody_reading_the_output_is_no_error() -> None:
    """As behind `| head -1`: one line is read, and the pipe closed."""
    command = [sys.executable, "-m", "igps", "help", "options"]
    environment = {**os.environ, "PYTHONPATH": str(SOURCE)}
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, env=environment) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


def test_names_of_files_are_read_as_utf8_in_the_c_locale(tmp_path: Path) -> None:
    (tmp_path / "é.stl").touch()
    code = "import os, sys, igps.cli; igps.cli._start_in_utf8(); print(os.listdir(sys.argv[1]))"
    command = [sys.executable, "-c", code, str(tmp_path)]
    environment = {**os.environ, "PYTHONPATH": str(SOURCE), "LC_ALL": "C", "PYTHONUTF8": "0"}
    done = subprocess.run(command, capture_output=True, env=environment, check=True)
    assert done.stdout.decode() == "['é.stl']\n"


def test_ctrl_c_during_the_imports_is_a_line() -> None:
    """The signal comes while torch is imported, for which the first seconds of a command go."""
    code = "\n".join(
        [
            "import os, signal",
            "class Interrupting:",
            "    def find_spec(self, name, path=None, target=None):",
            "        if name == 'torch': os.kill(os.getpid(), signal.SIGINT)",
            "sys.meta_path.insert(0, Interrupting())",
        ]
    )
    done = igps_with("retrieve", "folder", code=code)
    assert done.returncode == 130
    assert done.stderr == "igps: interrupted. Run again to continue: finished results are kept.\n"
