"""Studies of the library: `python -m training.study {robustness,damage,scales,surfaces,figure}`, `--help` for each."""

from __future__ import annotations

from igps.cli import Commands
from igps.cli import main as run
from training.studies.damage import damage_command
from training.studies.figure_command import pose, potential, topology
from training.studies.label_surfaces import surfaces
from training.studies.robustness import robustness_command
from training.studies.scales import scales

COMMANDS: Commands = {
    "robustness": robustness_command,
    "damage": damage_command,
    "scales": scales,
    "surfaces": surfaces,
    "figure": {"pose": pose, "topology": topology, "potential": potential},
}


def main() -> None:
    """Run the study that the words of the command line name."""
    run(COMMANDS, "python -m training.study", dict.fromkeys((pose, potential, topology), (".png",)))


if __name__ == "__main__":
    main()
