"""What a distance means, against counting; and for whom a calibration holds."""

import json
from dataclasses import replace

import numpy as np
import pytest
from training.calibrate import quantiles

from igps.descriptors import descriptor
from igps.descriptors.fingerprint import fingerprint
from igps.duplicates.calibration import KINDS, LEVELS, Calibration, Threshold, calibration_params
from igps.signature.signature import SignatureConfig
from own_descriptors import Same

CONFIG = SignatureConfig(n_eigenpairs=20)


@pytest.fixture(scope="module")
def drawn():
    generator = np.random.default_rng(0)
    return {kind: (1 + place) * generator.gamma(2.0, size=5000) for place, kind in enumerate(KINDS)}


@pytest.fixture
def calibration(drawn):
    threshold = Threshold(0.5, 1000, 0, 20, 19)
    return Calibration(
        "same",
        fingerprint(Same()),
        calibration_params(CONFIG),
        "random numbers",
        {kind: quantiles(values) for kind, values in drawn.items()},
        dict.fromkeys(KINDS, 5000),
        threshold,
        replace(threshold, distance=6.0),
    )


@pytest.mark.parametrize("distance", [0.3, 3.0])
def test_the_share_that_is_closer_is_the_one_that_is_counted(calibration, drawn, distance):
    for kind, values in drawn.items():
        assert calibration.share_closer(kind, distance) == pytest.approx(
            (values < distance).mean(), abs=0.02
        )


def test_shares_at_the_ends(calibration):
    for kind in KINDS:
        assert calibration.share_closer(kind, 0.0) == 0.0
        assert calibration.share_closer(kind, 1e9) == 1.0


def test_the_words_say_what_is_counted(calibration, drawn):
    distance = float(np.quantile(drawn["poses"], 0.6))
    parts = calibration.words(distance).split(", ")
    assert [part.split(" of ", 1)[1] for part in parts] == [
        "pairs of different classes",
        "bodies of one class",
        "poses of one body",
        "copies of one body",
    ]
    for part, kind in zip(parts, reversed(KINDS), strict=True):
        side, _, share, *_ = part.split()
        counted = (drawn[kind] < distance).mean()
        assert side == ("closer" if counted < 0.5 else "farther")
        expected = pytest.approx(
            100 * max(counted, 1 - counted),
            abs=2,
        )
        assert float(share) == expected
    assert "closer than all pairs of different classes" in calibration.words(0.0)


def test_a_share_is_never_rounded_up(calibration):
    """What 99.96 % are farther than is not all."""
    ends = replace(
        calibration,
        distances={kind: list(np.array(LEVELS) + 0.0) for kind in KINDS},
    )
    assert "closer than 99.9 % of poses of one body" in ends.words(0.0004)
    assert "closer than 98 % of poses of one body" in ends.words(0.011)


def test_it_holds_for_its_descriptor_its_parameters_and_its_signatures(calibration):
    calibration.check("same", Same(), CONFIG)
    with pytest.raises(
        ValueError, match="descriptor: expected same, whose distances are calibrated, got interior"
    ):
        calibration.check("interior", descriptor("interior"), CONFIG)
    with pytest.raises(ValueError, match="same: its calibration was made for other parameters"):
        replace(calibration, model="0").check("same", Same(), CONFIG)
    with pytest.raises(
        ValueError, match=r"resolution: expected 32, for which same is calibrated, got 16\. Use the"
    ):
        calibration.check("same", Same(), replace(CONFIG, resolution=16))


@pytest.mark.parametrize(
    ("coarseness", "limit"),
    [
        (0.0, 0.00006),
        (0.02, 0.12),
        (np.inf, 0.5),
    ],
)
def test_what_is_coarse_may_be_farther_apart(calibration, coarseness, limit):
    """Six times the coarseness, of which there is a least, and never more than any copies are."""
    assert calibration.limit(coarseness) == pytest.approx(limit)


def test_what_is_saved_is_loaded(calibration, tmp_path):
    calibration.save(tmp_path / "c.json")
    assert Calibration.load(tmp_path / "c.json") == calibration


@pytest.mark.parametrize(
    "text",
    ["", "[]", "{}", json.dumps({"descriptor": "pretrained"})],
)
def test_what_is_no_calibration_is_refused(text, tmp_path):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(
        ValueError, match=r"c\.json: expected a calibration as `Calibration\.save` writes it"
    ):
        Calibration.load(tmp_path / "c.json")


def test_the_shipped_one_is_of_the_shipped_descriptor():
    found = Calibration.load()
    module = descriptor("pretrained")
    found.check("pretrained", module, module.requirements.apply_to(SignatureConfig()))
    medians = [found.distances[kind][LEVELS.index(0.5)] for kind in KINDS]
    assert medians == sorted(medians)
    for kind in KINDS:
        assert list(found.distances[kind]) == sorted(found.distances[kind])
    assert found.same.n_found >= 0.99 * found.same.n_same
    assert found.same.n_false <= 0.001 * found.same.n_other
