"""The count of pairs by both back ends, against loops over pairs and against the dense definition for its gradients."""

import math
from itertools import combinations_with_replacement

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch.autograd import grad
from torch.nn.functional import normalize, one_hot
from torch.nn.utils.rnn import pad_sequence
from torch.testing import assert_close
from torch.utils.flop_counter import FlopCounterMode

from conftest import torch_threads
from igps.nn.axes import (
    PairValues,
    euclidean_distances,
    oriented_pairs,
    pair_twists,
)
from igps.nn.histograms import joint_histogram
from loops import cosines, distances, pair_histogram_by_loops, twists

FEW = [0.3, 0.5, 0.52, 1.9]
EQUAL = [0.25, 0.75, 1.25, 1.75, 2.25]
MANY = [0.1, 0.4, 0.401, 0.4012, 0.4013, 0.7, 0.9, 1.0, 1.1, 1.15, 1.3, 1.5, 1.6, 1.9, 2.2, 2.9]
TOWARDS = [-0.7, 0.1, 0.6]
AMONG = [-0.5, 0.3]
TWISTS = [-0.4, 0.0, 0.4]
BACK_ENDS = [
    "compiled",
    "torch",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
    ),
]


@pytest.fixture(params=BACK_ENDS)
def device(request):
    """Where the points are; on the CPU by compiled loops or by operations of PyTorch."""
    if request.param == "torch":
        request.getfixturevalue("without_loops")
    return "cuda" if request.param == "cuda" else "cpu"


def some(n_points=23, n_classes=3, seed=4):
    """Coordinates, points, directions, and memberships of which many are 0."""
    generator = torch.Generator().manual_seed(seed)

    def normal(width):
        return torch.randn(n_points, width, generator=generator, dtype=torch.float64)

    memberships = torch.rand(n_points, n_classes, generator=generator, dtype=torch.float64)
    memberships[::2] = (memberships[::2] > 0.6).double()
    memberships[memberships.sum(dim=1) == 0, 0] = 1
    return {
        "memberships": normalize(memberships, p=1, dim=1),
        "coordinates": normal(5) * 0.5,
        "points": normal(3) * 0.4,
        "directions": normalize(normal(3), dim=1),
        "heights": normal(1)[:, 0],
    }


def differences(heights, centres):
    """Of a height, as an axis of one's own would count it."""

    def between(rows, columns):
        return (rows[0][:, None, :, None] - columns[0][:, None, None, :]).abs()

    return PairValues((heights,), (centres,), between)


def centres(values, like):
    return torch.tensor(
        values, dtype=torch.promote_types(like.dtype, torch.float32), device=like.device
    )


# Layouts of axes, each with what is counted and what a loop counts.
KINDS = {
    "equal": (
        lambda s: euclidean_distances(s["coordinates"], centres(EQUAL, s["points"])),
        lambda s: [(distances(s["coordinates"]), EQUAL)],
    ),
    "few": (
        lambda s: euclidean_distances(s["points"], centres(FEW, s["points"])),
        lambda s: [(distances(s["points"]), FEW)],
    ),
    "many": (
        lambda s: euclidean_distances(s["coordinates"], centres(MANY, s["points"])),
        lambda s: [(distances(s["coordinates"]), MANY)],
    ),
    "own": (
        lambda s: differences(s["heights"], centres(FEW, s["points"])),
        lambda s: [
            (
                np.abs(
                    np.subtract.outer(
                        s["heights"].numpy(),
                        s["heights"].numpy(),
                    )
                ),
                FEW,
            )
        ],
    ),
    "cosines": (
        lambda s: oriented_pairs(
            s["points"], s["directions"], centres(TOWARDS, s["points"]), centres(AMONG, s["points"])
        ),
        lambda s: list(
            zip(
                cosines(s["points"], s["directions"]),
                (TOWARDS, TOWARDS, AMONG),
                strict=True,
            )
        ),
    ),
    "twists": (
        lambda s: pair_twists(s["points"], s["directions"], centres(TWISTS, s["points"])),
        lambda s: [(twists(s["points"], s["directions"]), TWISTS)],
    ),
    "cosines of five": (
        lambda s: oriented_pairs(
            s["coordinates"],
            normalize(s["coordinates"].roll(1, 0), dim=1),
            *[centres(AMONG, s["points"])] * 2,
        ),
        lambda s: [
            (v, AMONG)
            for v in cosines(
                s["coordinates"],
                normalize(s["coordinates"].roll(1, 0), dim=1),
            )
        ],
    ),
}
LAYOUTS = [
    ["many"],
    ["own"],
    ["few", "equal", "many"],
    ["cosines", "equal"],
    ["own", "cosines", "many"],
    ["cosines", "cosines of five"],
    ["equal", "twists"],
]


@pytest.fixture(params=[None, (5, 6)])
def block(request, monkeypatch):
    """Count all pairs at once, and by blocks of so many rows and columns that no number of points fills the last."""
    if request.param is None:
        return
    n_rows, n_columns = request.param
    monkeypatch.setattr("igps.nn._kernels.pairs_by_loops._MAX_COLUMNS", n_columns)
    monkeypatch.setattr("igps.nn._kernels.pairs_by_loops._BLOCK_SIZE", 2 * n_rows * n_columns)
    monkeypatch.setattr("igps.nn._kernels.pairs_by_torch._BLOCK", n_rows * 23 * 16)


def counted(layout, given):
    return joint_histogram(given["memberships"], [KINDS[kind][0](given) for kind in layout])


@pytest.mark.parametrize("layout", LAYOUTS, ids=" × ".join)
@pytest.mark.parametrize("n_classes", [1, 3])
def test_histogram_is_the_sum_of_hats_over_all_pairs(device, layout, n_classes, block):
    given = some(n_classes=n_classes)
    result = counted(layout, {name: value.to(device) for name, value in given.items()}).cpu()
    axes = [axis for kind in layout for axis in KINDS[kind][1](given)]
    assert_allclose(result, pair_histogram_by_loops(given["memberships"], axes), atol=1e-12)
    assert float(result.sum()) == pytest.approx(1, abs=1e-12)
    single = counted(
        layout,
        {name: value.float().to(device) for name, value in given.items()},
    )
    assert single.dtype == torch.float32
    assert_allclose(single.cpu(), result, atol=1e-6)


@pytest.mark.parametrize(
    "layout",
    [
        [0.5, 0.5 + 1e-9, 0.5 + 2e-9, 0.9, 0.9001, 1.1],
        [1e-3, 1e4],
        [-2.0, -1.0],
    ],
)
def test_any_spacing_of_centres_is_exact(device, layout):
    given = some(40)
    bins = centres(layout, given["points"]).to(device)
    pairs = euclidean_distances(given["coordinates"].to(device), bins)
    result = joint_histogram(given["memberships"].to(device), [pairs])
    axis = (distances(given["coordinates"]), layout)
    assert_allclose(result.cpu(), pair_histogram_by_loops(given["memberships"], [axis]), atol=1e-12)


def test_single_precision_is_summed_in_double(device):
    """Half a million pairs whose weights are not whole: in single precision the sum would be off by some 10⁻⁴."""
    given = {name: value.to(device) for name, value in some(1000).items()}
    result = counted(
        ["many"],
        {name: value.float() for name, value in given.items()},
    )
    assert float(result.sum()) == pytest.approx(1, abs=1e-6)
    assert_allclose(result.cpu(), counted(["many"], given).cpu(), atol=1e-7)


@pytest.mark.parametrize("layout", [EQUAL, MANY])
def test_whole_pairs_of_single_precision_are_as_those_of_double(layout):
    """Against double precision: one-hot points are counted in integers; sorted points make neighbours similar."""
    generator = torch.Generator().manual_seed(6)
    points = torch.randn(2300, 3, generator=generator).sort(dim=0).values * 0.4
    memberships = one_hot(torch.randint(3, (2300,), generator=generator), 3).double()
    result, expected = (
        joint_histogram(
            memberships.to(dtype),
            [euclidean_distances(points.to(dtype), torch.tensor(layout).to(dtype))],
        )
        for dtype in (torch.float32, torch.float64)
    )
    assert_allclose(result, expected, atol=1e-7)


@pytest.mark.parametrize(
    ("spread", "bin_of_all"),
    [(0.0, 0), (1e4, 4)],
)
def test_a_block_of_pairs_that_all_fall_into_one_bin(spread, bin_of_all):
    """The largest number of pairs that one integer counts, with the largest share of a pair and with share 0."""
    points = torch.arange(1.0, 2401.0)[:, None] * spread
    expected = one_hot(torch.tensor([bin_of_all]), 5).float()
    assert torch.equal(
        joint_histogram(
            torch.ones(2400, 1),
            [euclidean_distances(points, torch.tensor(EQUAL))],
        ),
        expected,
    )


def test_pairs_that_are_not_counted_take_no_products():
    """Of 1,000 points 499,500 pairs are counted, of 4 flops each in two dimensions."""
    points = torch.randn(1000, 2, generator=torch.Generator().manual_seed(3))
    with FlopCounterMode(display=False) as counter:
        joint_histogram(
            torch.ones(1000, 1),
            [euclidean_distances(points, torch.tensor(EQUAL))],
        )
    assert 499_500 * 4 <= counter.get_total_flops() < 1.15 * 499_500 * 4


def test_features_are_those_of_a_loop():
    given = some(12)
    i, j = np.triu_indices(12, 1)
    expected = cosines(given["points"], given["directions"])
    pairs = oriented_pairs(given["points"], given["directions"], TOWARDS, AMONG)
    for feature, one in zip(pairs.between(pairs.inputs, pairs.inputs), expected, strict=True):
        assert_allclose(feature[i, j], one[i, j], atol=1e-12)


def test_points_that_coincide_have_no_line(device):
    directions = some(2)["directions"].float().to(device)
    points = torch.rand(1, 3, device=device).expand(2, -1)
    angles = torch.tensor([-1.0, 0.0, 1.0], device=device)
    pairs = oriented_pairs(points, directions, angles, angles)
    first, second, _ = pairs.between(pairs.inputs, pairs.inputs)[:, 0, 1]
    assert first == second == 0
    result = joint_histogram(points.new_ones(2, 1), [pairs])
    assert float(result[0, 1, 1].sum()) == pytest.approx(1)


def test_a_reflection_turns_the_order_of_twists(device):
    given = {name: values.to(device) for name, values in some().items()}
    mirror = torch.tensor(
        [1.0, -1.0, 1.0],
        dtype=torch.float64,
        device=device,
    )
    mirrored = {
        **given,
        "points": given["points"] * mirror,
        "directions": given["directions"] * mirror,
    }
    counts = counted(["equal", "twists"], given)
    assert float((counts - counts.flip(-1)).abs().max()) > 1e-3
    assert_close(counted(["equal", "twists"], mirrored), counts.flip(-1))


@pytest.mark.parametrize("joint", [False, True])
def test_no_cell_is_negative(device, joint):
    """Isolated pairs just below a centre: no other pair hides a rounding error in the cell before it."""
    generator = torch.Generator().manual_seed(0)
    layout = ((torch.arange(12) + 0.5) / 3).to(device)
    below = torch.nextafter(layout[1:].cpu(), torch.zeros(())).repeat(20)
    length = torch.cat(
        [
            below,
            below * (1 - 6e-8 * torch.rand(len(below), generator=generator)),
        ]
    )
    ends = torch.zeros(len(length), 2, 3)
    ends[:, 1] = length[:, None] * normalize(
        torch.randn(len(length), 3, generator=generator), dim=1
    )
    soft = torch.rand(len(length), 2, 1, generator=generator)
    axes = [ends, ends.roll(1, dims=2)] if joint else [ends]
    result = joint_histogram(
        torch.cat([soft, 1 - soft], dim=2).to(device),
        [euclidean_distances(one.to(device), layout) for one in axes],
    )
    assert result.min() >= 0
    assert_close(
        result.flatten(1).sum(dim=1), torch.ones(len(length), device=device), atol=1e-6, rtol=0
    )


def test_no_cell_of_cosines_is_negative(device):
    """χ² refuses a histogram with a cell of −1e−18; a pair close below several centres leaves next to nothing there."""
    below = torch.logspace(-6, -3, 40)[:, None]
    angle = torch.linspace(0.1, 3.0, 20).expand(40, -1)
    both = torch.stack([angle, angle + torch.acos(0.4 - below)], dim=2).flatten(0, 1)
    directions = torch.stack(
        [both.cos(), both.sin(), torch.zeros_like(both)],
        dim=2,
    )
    points = torch.zeros(800, 2, 3)
    points[:, 1, 0] = (0.75 - below).expand(-1, 20).flatten()
    angles = (torch.arange(5) * 0.4 - 0.8).to(device)
    bins = (torch.arange(6) * 0.5 + 0.25).to(device)
    pairs = [
        euclidean_distances(points.to(device), bins),
        oriented_pairs(points.to(device), directions.to(device), angles, angles),
    ]
    assert joint_histogram(torch.ones(800, 2, 1, device=device), pairs).min() >= 0


def test_shapes_of_any_sizes_are_counted_as_alone(device):
    sizes = [5, 40, 2, 38, 12, 13, 40]
    shapes = [{name: value.to(device) for name, value in some(n, seed=n).items()} for n in sizes]
    padded = {
        name: pad_sequence(
            [one[name] for one in shapes],
            batch_first=True,
            padding_value=torch.nan,
        )
        for name in shapes[0]
    }
    mask = torch.arange(40, device=device) < torch.tensor(sizes, device=device)[:, None]
    layout = centres(MANY, padded["points"])
    together = joint_histogram(
        padded["memberships"], [euclidean_distances(padded["coordinates"], layout)], mask
    )
    for found, one in zip(together, shapes, strict=True):
        expected = joint_histogram(
            one["memberships"], [euclidean_distances(one["coordinates"], layout)]
        )
        assert_close(found, expected, rtol=0, atol=1e-12)


def test_threads_change_no_bit(many_cores):
    """700 points, several blocks for each share, and the gradient."""
    given = {name: value.requires_grad_() for name, value in some(700).items()}
    upstream = None
    results = []
    for n_threads in (1, 2, 5):
        with torch_threads(n_threads):
            histogram = counted(["many", "cosines"], given)
            if upstream is None:
                upstream = torch.randn(
                    histogram.shape, generator=torch.Generator().manual_seed(4)
                ).double()
            leaves = [
                given[name] for name in ("memberships", "coordinates", "points", "directions")
            ]
            results.append([histogram.detach(), *grad(histogram, leaves, upstream)])
            assert torch.get_num_threads() == n_threads
    for other in results[1:]:
        for one, same in zip(results[0], other, strict=True):
            assert torch.equal(one, same)


def dense(memberships, values, layouts):
    """The definition over all pairs at once, (pairs,) values of each axis, for its gradients."""
    i, j = torch.triu_indices(
        len(memberships),
        len(memberships),
        1,
        device=memberships.device,
    )
    shares = None
    for value, layout in zip(values, layouts, strict=True):
        passed = ((value[:, None] - layout[:-1]) / layout.diff()).clamp(0, 1)
        ones = torch.ones_like(passed[:, :1])
        share = torch.cat([ones, passed], dim=1) - torch.cat([passed, 0 * ones], dim=1)
        share = share.view(
            len(i),
            *[1] * (0 if shares is None else shares.ndim - 1),
            -1,
        )
        shares = share if shares is None else shares.unsqueeze(-1) * share
    rows = []
    for a, b in combinations_with_replacement(range(memberships.shape[1]), 2):
        weight = memberships[i, a] * memberships[j, b]
        if a != b:
            weight = weight + memberships[i, b] * memberships[j, a]
        rows.append(torch.tensordot(weight, shares, dims=1))
    return torch.stack(rows) / len(i)


@pytest.mark.parametrize("layout", LAYOUTS, ids=" × ".join)
def test_gradients_equal_those_of_the_dense_definition(device, layout, block):
    """Also by memberships that are zero, whose gradient is not."""
    given = {name: value.to(device).requires_grad_() for name, value in some(29).items()}
    pairs = [KINDS[kind][0](given) for kind in layout]
    leaves, i, j = [given["memberships"]], *torch.triu_indices(29, 29, 1, device=device)
    values = []
    for kind, one in zip(layout, pairs, strict=True):
        leaves += [x for x in one.inputs if x.is_leaf] + [c.requires_grad_() for c in one.centres]
        if "cosines" in kind:
            points, directions = one.inputs
            line = normalize(points[j] - points[i], dim=1)
            ends = [
                (directions[i] * line).sum(dim=1),
                -(directions[j] * line).sum(dim=1),
            ]
            values += [
                torch.maximum(*ends),
                torch.minimum(*ends),
                (directions[i] * directions[j]).sum(dim=1),
            ]
        elif kind == "twists":
            way = one.inputs[0][j] - one.inputs[0][i]
            turned = torch.linalg.cross(
                one.inputs[1][i],
                one.inputs[1][j],
            )
            values.append((turned * way).sum(dim=1) / way.norm(dim=1))
        elif kind == "own":
            values.append((one.inputs[0][i] - one.inputs[0][j]).abs())
        else:
            values.append((one.inputs[0][i] - one.inputs[0][j]).norm(dim=1))
    leaves = list({id(leaf): leaf for leaf in leaves}.values())
    expected = dense(given["memberships"], values, [c for one in pairs for c in one.centres])
    result = joint_histogram(given["memberships"], pairs)
    upstream = torch.randn(
        result.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64
    ).to(device)
    for by_hand, by_torch in zip(
        grad(result, leaves, upstream, retain_graph=True),
        grad(expected, leaves, upstream),
        strict=True,
    ):
        assert (by_torch.abs() > 1e-9).any()
        assert_close(by_hand, by_torch, rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("layout", [["many"], ["few", "own"], ["few", "cosines"], ["twists"]])
def test_gradcheck(device, layout):
    given = some(5, n_classes=2, seed=1)
    names = [
        "memberships",
        *dict.fromkeys({"many": "coordinates", "own": "heights"}.get(k, "points") for k in layout),
    ]
    leaves = [given[name].to(device).requires_grad_() for name in names]

    def histogram(logits, *others):
        moved = dict(
            zip(
                names,
                (logits.softmax(dim=1), *others),
                strict=True,
            )
        )
        return counted(
            layout,
            {
                **{name: value.to(device) for name, value in given.items()},
                **moved,
            },
        )

    for gradient in grad(histogram(*leaves).square().sum(), leaves):
        assert (gradient.abs() > 1e-9).any()
    # A GPU adds in any order.
    some_order = 1e-12 if device == "cuda" else 0
    assert torch.autograd.gradcheck(histogram, leaves, nondet_tol=some_order)
    assert torch.autograd.gradgradcheck(histogram, leaves, nondet_tol=some_order)


@pytest.mark.parametrize("layout", [["many"], ["few", "own"], ["few", "cosines"], ["twists"]])
def test_gradients_taken_under_autocast_keep_their_digits(layout):
    given = {name: value.float().requires_grad_() for name, value in some(30).items()}
    leaves = [given["coordinates" if layout == ["many"] else "points"]]
    [expected] = grad(counted(layout, given).square().sum(), leaves)
    with torch.autocast("cpu", torch.bfloat16):
        [found] = grad(counted(layout, given).square().sum(), leaves)
    assert_close(
        found,
        expected,
        rtol=1e-5,
        atol=1e-6 * float(expected.abs().max()),
    )


def test_coincident_points_have_finite_gradients(device):
    embedding = torch.zeros(6, 3, dtype=torch.float64, device=device)
    embedding[3:] = 0.5
    embedding.requires_grad_()
    layout = centres([-0.1, 0.3, 1.0], embedding)  # a slope at distance 0
    result = joint_histogram(embedding.new_ones(6, 1), [euclidean_distances(embedding, layout)])
    near, far = (grad(result[0, k], embedding, retain_graph=True)[0] for k in (0, 2))
    assert torch.isfinite(near).all()
    # 9 of the 15 pairs are at √0.75; pulling one point away along the diagonal stretches 3 of them by 1/√3 each axis.
    assert_allclose(far[3:].cpu(), 3 / 15 / 0.7 / math.sqrt(3), rtol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {name: value[:1] for name, value in some(5, 2).items()},
            "two points to form a pair, got 1",
        ),
        (
            {"points": torch.zeros(4, 3)},
            r"expected values for each of 5 points, got shape \(4, 3\)",
        ),
        ({"points": torch.full((5, 3), torch.nan)}, "expected finite values, got NaN or infinity"),
        (
            {"coordinates": torch.full((5, 3), torch.inf)},
            "expected finite values, got NaN or infinity",
        ),
        (
            {"points": torch.tensor([[-1e19], [1e19]] * 2 + [[0.0]])},
            "expected distances that can be squared",
        ),
        (
            {"memberships": torch.full((5, 2), 0.4)},
            "memberships: expected non-negative rows of sum 1",
        ),
        ({"memberships": torch.tensor([[1.5, -0.5]] * 5)}, "non-negative"),
    ],
)
def test_bad_points_are_refused(change, message):
    good = {name: value.float() for name, value in some(5, n_classes=2).items()}
    counted(["few", "many"], good)
    with pytest.raises(ValueError, match=message):
        counted(["few", "many"], {**good, **change})


@pytest.mark.parametrize(
    "layout",
    [[0.5, 0.5, 1.0], [0.5, torch.inf], [torch.nan, 1.0], [1.0], []],
)
def test_bad_centres_are_refused(layout):
    points = torch.rand(5, 3)
    bins = torch.tensor(layout)
    for pairs in (
        [euclidean_distances(points, bins)],
        [
            oriented_pairs(
                points,
                points,
                bins,
                torch.rand(2).sort()[0],
            )
        ],
    ):
        with pytest.raises(
            ValueError, match="centres: expected two or more finite, ascending values"
        ):
            joint_histogram(torch.ones(5, 1), pairs)


def test_directions_are_of_the_shape_of_the_points():
    points = torch.rand(10, 3)
    layout = torch.tensor([0.0, 1.0])
    with pytest.raises(
        ValueError, match=r"directions: expected the shape of the points, \(10, 3\), got \(10, 2\)"
    ):
        oriented_pairs(points, points[:, :2], layout, layout)
    for inputs in ((points * torch.inf, points), (points, points * torch.inf)):
        with pytest.raises(ValueError, match="expected finite values"):
            joint_histogram(torch.ones(10, 1), [oriented_pairs(*inputs, layout, layout)])


def test_far_points_are_counted_as_long_as_their_distances_can_be_squared():
    far = torch.tensor([[-1e18, 0.0], [1e18, 0.0]])
    result = joint_histogram(
        torch.ones(2, 1),
        [euclidean_distances(far, torch.tensor([0.5, 1.0]))],
    )
    assert result.tolist() == [[0, 1]]
