"""Studies of the library: `python -m training.study NAME`, with `--help` for each."""

from igps.cli import Commands
from igps.cli import main as run
from training.studies.alike import alike
from training.studies.damage import damage_command
from training.studies.explaining import explaining
from training.studies.figure_command import pose, potential, topology
from training.studies.label_surfaces import surfaces
from training.studies.outlying import outlying
from training.studies.people import people
from training.studies.power import power
from training.studies.robustness import robustness_command
from training.studies.scales import scales

COMMANDS: Commands = {
    "robustness": robustness_command,
    "damage": damage_command,
    "scales": scales,
    "alike": alike,
    "people": people,
    "surfaces": surfaces,
    "power": power,
    "explaining": explaining,
    "outlying": outlying,
    "figure": {"pose": pose, "topology": topology, "potential": potential},
}


def main() -> None:
    """Run the study named on the command line."""
    run(COMMANDS, "python -m training.study", dict.fromkeys((pose, potential, topology), (".png",)))


if __name__ == "__main__":
    main()
