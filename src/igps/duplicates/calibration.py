"""The meaning of distances: distributions over pairs of generated bodies, and thresholds for copies and poses."""

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
"""The file of the calibration of `pretrained`."""

KINDS = {
    "copies": "copies of one body",
    "poses": "poses of one body",
    "bodies": "bodies of one class",
    "classes": "pairs of different classes",
}
"""Kinds of pairs in words, from the most alike to the least."""

LEVELS = (
    0.0,
    0.001,
    0.002,
    0.005,
    0.01,
    0.02,
    0.05,
    *(i / 10 for i in range(1, 10)),
    0.95,
    0.98,
    0.99,
    0.995,
    0.998,
    0.999,
    1.0,
)
"""Levels of the quantiles of distances that are stored."""

FINEST = 1e-5
"""Lower bound of a coarseness, over √area: 2,000 samples may miss small parts of a surface that are not flat."""

_SIGNATURE_PARAMS = ("algorithm_version", "resolution", "min_samples", "n_surface_samples")


@dataclass(frozen=True)
class Threshold:
    """A distance up to which two files are called the same, with counts of its errors."""

    distance: float
    n_other: int  # pairs that are not the same
    n_false: int  # of these, pairs within the distance
    n_same: int  # pairs that are the same
    n_found: int  # of these, pairs within the distance


@dataclass(frozen=True)
class Calibration:
    """Distances between generated bodies, by a descriptor and by their aligned surfaces."""

    descriptor: str  # name
    model: str  # `fingerprint` of the descriptor
    # Version of the Signatures, and the parameters that distances depend on
    signatures: Mapping[str, int]
    made_of: str  # the bodies that were measured, in words
    # Quantiles at `LEVELS` of the descriptor's distance, for each of `KINDS`
    distances: Mapping[str, Sequence[float]]
    n_pairs: Mapping[str, int]  # for each of `KINDS`
    same: Threshold  # limit of `surface_distance` for copies at any level of detail
    detail: Threshold  # limit, for copies, of the ratio of `surface_distance` to the larger `coarseness` of the two

    def share_closer(self, kind: str, distance: float) -> float:
        """Return the share of the pairs of a kind that are closer than a distance, interpolated between quantiles."""
        quantiles = np.asarray(self.distances[kind])
        if distance < quantiles[0]:
            return 0.0
        # If quantiles are equal, the last of their levels is returned: pairs at exactly this distance count as closer
        return float(np.interp(distance, np.maximum.accumulate(quantiles), LEVELS))

    def words(self, distance: float) -> str:
        """Describe a distance of the descriptor: "closer than 99.8 % of pairs of different classes, ..."."""
        phrases = []
        for kind, pairs in reversed(KINDS.items()):
            closer = self.share_closer(kind, distance)
            side, share = ("closer", 1 - closer) if closer < 0.5 else ("farther", closer)
            phrases.append(f"{side} than {_percent(share)} {pairs}")
        return ", ".join(phrases)

    def limit(self, coarseness: float) -> float:
        """Return the largest `surface_distance` of copies, given the larger `Surfaces.coarseness` of the two bodies."""
        return min(self.same.distance, self.detail.distance * max(coarseness, FINEST))

    def check(
        self, descriptor: str | Descriptor, module: Descriptor, config: SignatureConfig
    ) -> None:
        """Raise a ValueError unless the calibration belongs to a descriptor and to Signatures of a configuration."""
        name = name_of(descriptor)
        if name != self.descriptor:
            expected = f"expected {self.descriptor}, whose distances are calibrated, got {name}"
            raise ValueError(f"descriptor: {expected}.")
        if fingerprint(module) != self.model:
            remedy = "Make a new calibration for them"
            raise ValueError(
                f"{self.descriptor}: its calibration was made for other parameters. {remedy}."
            )
        self.check_signatures(config)

    def check_signatures(self, config: SignatureConfig) -> None:
        """Raise a ValueError unless the calibration belongs to Signatures of a configuration."""
        params = calibration_params(config)
        for name, value in self.signatures.items():
            if params[name] != value:
                raise ValueError(
                    f"{name}: expected {value}, for which {self.descriptor} is calibrated, got {params[name]}. Use the "
                    "default, or make a new calibration."
                )

    def save(self, path: str | Path) -> None:
        """Write the calibration as JSON."""
        Path(path).write_text(json.dumps(asdict(self), indent=1) + "\n")

    @classmethod
    def load(cls, path: str | Path = CALIBRATION) -> Self:
        """Read a calibration that `save` wrote. Raise a ValueError if the file holds none."""
        try:
            fields: dict[str, Any] = json.loads(Path(path).read_text())
            calibration = cls(
                **fields | {name: Threshold(**fields[name]) for name in ("same", "detail")}
            )
            if any(len(calibration.distances[kind]) != len(LEVELS) for kind in KINDS):
                raise ValueError("other quantiles")
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{path}: expected a calibration as `Calibration.save` writes it ({error})."
            ) from error
        return calibration


def calibration_params(config: SignatureConfig) -> dict[str, int]:
    """Return the parameters of the Signatures that distances depend on."""
    return {name: config.as_dict()[name] for name in _SIGNATURE_PARAMS}


def _percent(share: float) -> str:
    """Format a share with the digits that the quantiles support, rounded down: "60 % of", "99.8 % of", "all"."""
    if share >= 1:
        return "all"
    digits = 1 if share > 0.99 else 0
    return f"{np.floor(share * 100 * 10**digits) / 10**digits:.{digits}f} % of"
