"""`python -m training.study surfaces` prints what the study measures."""

from __future__ import annotations

import pytest
from training.studies import label_surfaces
from training.study import COMMANDS


def test_medians_of_each_kind_are_printed_in_percent(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def measured(
        n_voxels: tuple[int, ...], descriptors: list[str], n_turns: int
    ) -> list[label_surfaces.Measured]:
        errors = [-0.01, 0.03, 0.02][:n_turns]
        away = dict.fromkeys(descriptors, 0.05)
        return [
            label_surfaces.Measured(kind, n_voxels[0], 1, error, 2 * error, away)
            for kind in label_surfaces.KINDS
            for error in errors
        ]

    monkeypatch.setattr(label_surfaces, "measure", measured)
    COMMANDS["surfaces"](n_turns=3, descriptors=["interior"])  # type: ignore[operator]
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == 3 * (len(label_surfaces.KINDS) + 1)
    assert "4 voxels, ball: volume 2.00, area 4.00" in printed[0]
    assert "16 voxels, all: volume 2.00, area 4.00, interior 5.0" in printed[-1]
