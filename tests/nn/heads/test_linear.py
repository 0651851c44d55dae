"""Logistic regression of form, numbers and size, against the same regression by hand."""

import numpy as np
import pytest
import torch
from sklearn.linear_model import LogisticRegression

from igps.nn.heads import LinearHead


def rows(n_classes):
    """Histograms of 20 cells, 3 numbers and size of 60 bodies; the first number tells the classes."""
    generator = torch.Generator().manual_seed(0)
    labels = torch.arange(60) % n_classes
    cells = torch.rand(60, 20, generator=generator)
    numbers = torch.randn(60, 4, generator=generator)
    numbers[:, 0] += 2 * labels
    return torch.cat(
        [cells / cells.sum(dim=1, keepdim=True), numbers],
        dim=1,
    ), labels + 5


@pytest.mark.parametrize("n_classes", [2, 3])
def test_probabilities_are_those_of_logistic_regression(n_classes):
    x, y = rows(n_classes)
    head = LinearHead(parts=("numbers", "size"), n_numbers=3).fit(x, y, calibrate=False)
    columns = x[:, 20:].double().numpy()
    scaled = (columns - columns.mean(axis=0)) / columns.std(axis=0)
    by_hand = LogisticRegression(C=0.1, class_weight="balanced", max_iter=2000).fit(scaled, y)
    np.testing.assert_allclose(
        head.probabilities(x), by_hand.predict_proba(scaled), rtol=1e-3, atol=1e-4
    )
    assert head.classes.tolist() == sorted(set(y.tolist()))


@pytest.mark.parametrize("parts", [("form",), ("numbers",), ("form", "numbers", "size")])
def test_only_named_parts_are_used_and_the_state_is_kept(parts, tmp_path):
    x, y = rows(3)
    head = LinearHead(parts=parts, n_numbers=3).fit(x, y)
    changed = x.clone()
    columns = {
        "form": slice(0, 20),
        "numbers": slice(20, 23),
        "size": slice(23, 24),
    }
    for part, place in columns.items():
        if part not in parts:
            changed[:, place] = 7.0
    assert torch.equal(head(changed), head(x))
    again = LinearHead(parts=parts, n_numbers=3)
    again.load_state_dict(head.state_dict())
    assert torch.equal(again.probabilities(x), head.probabilities(x))
    assert torch.equal(
        again.strangeness(x) >= again.strange_from, head.strangeness(x) >= head.strange_from
    )
    far = x.clone()
    far[:, 20:] += 40
    if "numbers" in parts:
        assert bool((head.strangeness(far) > head.strange_from).all())


def test_what_is_no_part_or_not_fitted_says_so():
    with pytest.raises(ValueError, match="parts: expected one of form, numbers, size, got 'shape'"):
        LinearHead(parts=("shape",))
    with pytest.raises(ValueError, match="parts: expected at least one"):
        LinearHead(parts=())
    with pytest.raises(RuntimeError, match="expected to be fitted first"):
        LinearHead(parts=("numbers",)).probabilities(rows(2)[0])
