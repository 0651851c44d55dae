"""Measure what the distances of `pretrained` mean, on generated bodies that it was not fitted to.

    python -m training.calibrate

makes the calibration that the package ships: the distances between copies of a body (remeshed, simplified to half,
scaled, mirrored and moved, in another file format, and all of these at once), between poses of a body, between bodies
of a class and between classes, and the thresholds up to which two files are the same. Copies lengthened by 2 % of √area
count as different, so that the thresholds separate parts of slightly different lengths. The seed of the bodies differs
from that of pretrain.py.
"""

from jsonargparse import auto_cli

from igps.cli import errors_as_messages
from training.studies.calibration import calibrate

if __name__ == "__main__":
    with errors_as_messages():
        auto_cli(calibrate)
