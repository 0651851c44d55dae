"""Measure what the distances of `pretrained` mean, on generated bodies that it was not fitted to.

    python -m training.calibrate

makes the calibration that the package ships: how far apart copies of a body are (other triangles, half of them, scaled,
mirrored and turned, another file format, and all of that), poses of a body, bodies of a class, and classes; and from
which distance on two files are not the same. To tell a part from one that is a little longer, bodies are lengthened by
2 % of the root of their area too. The bodies are those of another seed than pretrain.py's.
"""

from jsonargparse import auto_cli

from igps.cli import faults_in_a_sentence
from training.studies.calibration import calibrate

if __name__ == "__main__":
    with faults_in_a_sentence():
        auto_cli(calibrate)
