"""What distances mean: how far apart pairs of generated bodies are, by how much they have in common."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from igps.descriptors.fingerprint import fingerprint, name_of
from igps.descriptors.pretrained.descriptor import PRETRAINED
from igps.nn.descriptor import Descriptor
from igps.signature.signature import SignatureConfig

CALIBRATION = PRETRAINED.with_name("pretrained.calibration.json")
"""The calibration of `pretrained`, written by training/calibrate.py."""

KINDS = {
    "copies": "copies of one body",
    "poses": "poses of one body",
    "bodies": "bodies of one class",
    "classes": "pairs of different classes",
}
"""The pairs, from those that have most in common to those that have least, in words."""

LEVELS = (0.0, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, *(i / 10 for i in range(1, 10)),
          0.95, 0.98, 0.99, 0.995, 0.998, 0.999, 1.0)  # fmt: skip
"""Shares of pairs whose greatest distance is kept."""

FINEST = 1e-5
"""A smaller coarseness counts as this, of √area: 2,000 samples may miss what little is not flat."""

_DEPENDS_ON = ("algorithm_version", "resolution", "min_samples", "n_surface_samples")


@dataclass(frozen=True)
class Threshold:
    """A distance up to which two files are called the same, and how often that was wrong and right."""

    distance: float
    n_other: int  # pairs that are not the same, on which it was counted
    n_false: int  # those of them that it takes for the same
    n_same: int  # pairs that are
    n_found: int  # those of them that it finds


@dataclass(frozen=True)
class Calibration:
    """Distances between generated bodies, by a descriptor and by their surfaces laid onto each other."""

    descriptor: str  # its name
    model: str  # its `fingerprint`
    signatures: Mapping[str, int]  # version of the Signatures, and those of their parameters that distances depend on
    made_of: str  # what was measured, in words
    distances: Mapping[str, Sequence[float]]  # of each of `KINDS` the quantiles at `LEVELS`, by the descriptor
    n_pairs: Mapping[str, int]  # of each of `KINDS`, how many pairs
    near: float  # the descriptor's distance beyond which no pair is looked at: twice the largest between copies
    same: Threshold  # of `surface_distance`: up to it two files may show the same body in the same shape
    # Of the same over the larger of the two `coarseness`, which leaves open what a surface's level of detail has lost:
    # up to it they do
    detail: Threshold
    pose: Threshold  # of the descriptor's distance: up to it they show poses of one body

    def share_closer(self, kind: str, distance: float) -> float:
        """Which share of the pairs of a kind is closer than a distance, interpolated between the quantiles."""
        quantiles = np.asarray(self.distances[kind])
        if distance < quantiles[0]:
            return 0.0
        # Of equal quantiles the last: what is as far as they are is farther than none of them.
        return float(np.interp(distance, np.maximum.accumulate(quantiles), LEVELS))

    def words(self, distance: float) -> str:
        """What a distance of the descriptor means: "closer than 99.8 % of pairs of different classes, ..."."""
        told = []
        for kind, words in reversed(KINDS.items()):
            closer = self.share_closer(kind, distance)
            side, share = ("closer", 1 - closer) if closer < 0.5 else ("farther", closer)
            told.append(f"{side} than {_percent(share)} {words}")
        return ", ".join(told)

    def limit(self, coarseness: float) -> float:
        """The `surface_distance` up to which two files show the same body in the same shape.

        It depends on the larger of the two `igps.gallery.surfaces.Surfaces.coarseness`.
        """
        return min(self.same.distance, self.detail.distance * max(coarseness, FINEST))

    def check(self, descriptor: str | Descriptor, module: Descriptor, config: SignatureConfig) -> None:
        """Raise a ValueError unless it belongs to a descriptor (its name, and the module) and to such Signatures."""
        name = name_of(descriptor)
        if name != self.descriptor:
            calibrated = f"expected {self.descriptor}, whose distances are calibrated, got {name}"
            raise ValueError(f"descriptor: {calibrated}. A gallery is of it if it is built with --size ignore.")
        if fingerprint(module) != self.model:
            raise ValueError(
                f"{self.descriptor}: its calibration was made for other parameters of it. Make one by "
                "training/calibrate.py."
            )
        found = calibration_params(config)
        for parameter, value in self.signatures.items():
            if found[parameter] != value:
                raise ValueError(
                    f"{parameter}: expected {value}, as of the signatures that {self.descriptor} is calibrated for, "
                    f"got {found[parameter]}. Leave it as it is, or make a calibration by training/calibrate.py."
                )

    def save(self, path: str | Path) -> None:
        """Write it as JSON."""
        Path(path).write_text(json.dumps(asdict(self), indent=1) + "\n")

    @classmethod
    def load(cls, path: str | Path = CALIBRATION) -> Self:
        """What `save` wrote; a ValueError if it is no calibration."""
        try:
            found: dict[str, Any] = json.loads(Path(path).read_text())
            one = cls(**found | {name: Threshold(**found[name]) for name in ("same", "detail", "pose")})
            if any(len(one.distances[kind]) != len(LEVELS) for kind in KINDS):
                raise ValueError("other quantiles")
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: expected a calibration as training/calibrate.py writes it ({error}).") from error
        return one


def calibration_params(config: SignatureConfig) -> dict[str, int]:
    """What a calibration keeps of the Signatures that it was made with."""
    return {name: config.as_dict()[name] for name in _DEPENDS_ON}


def _percent(share: float) -> str:
    """With as many digits as there are quantiles for, and never rounded up: 60 % of, 99.8 % of, all."""
    if share >= 1:
        return "all"
    digits = 1 if share > 0.99 else 0
    return f"{np.floor(share * 100 * 10**digits) / 10**digits:.{digits}f} % of"
