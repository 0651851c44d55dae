"""Retrieval scores against hand-worked rankings, scikit-learn and loops over ranks."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from sklearn.metrics import average_precision_score

from igps.retrieval import (
    chi_square,
    euclidean,
    precision_recall_curve,
    retrieval_scores,
    scores_of_queries,
)
from igps.retrieval.metric import RetrievalScoresMetric
from igps.retrieval.scores import SCORE_NAMES

LOG3 = math.log2(3)


def random_case(*, n, n_classes, seed, ties=False):
    """Random distances (n, n), not symmetric, with every class of a size of its own."""
    generator = torch.Generator().manual_seed(seed)
    distances = torch.rand(
        n,
        n,
        generator=generator,
        dtype=torch.float64,
    )
    if ties:
        distances = (distances * 5).floor()
    labels = torch.randint(
        n_classes,
        (n,),
        generator=generator,
    )
    return distances, labels


def ranked_relevance(distances, labels, query):
    """Leave-one-out rel(1), rel(2), … of one query, by sorting (distance, index) pairs."""
    others = [other for other in range(len(labels)) if other != query]
    others.sort(key=lambda other: float(distances[query, other]))
    return [labels[other] == labels[query] for other in others]


def scores_by_loops(relevant):
    """All scores of one ranked list, straight from their definitions."""
    n_relevant = sum(relevant)

    def hits(first):
        return sum(relevant[:first])

    gain = ideal = 0.0
    for k, rel in enumerate(relevant, start=1):
        discount = 1.0 if k == 1 else 1 / math.log2(k)
        gain += discount * rel
        ideal += discount * (k <= n_relevant)
    seen = min(32, len(relevant))
    precision = hits(seen) / seen
    recall = hits(seen) / n_relevant
    with_self = [True, *relevant]
    return {
        "nn": float(relevant[0]),
        "ft": hits(n_relevant) / n_relevant,
        "st": hits(2 * n_relevant) / n_relevant,
        "e": 2 / (1 / precision + 1 / recall) if precision else 0.0,
        "dcg": gain / ideal,
        "adr": sum(hits(i) / i for i in range(1, n_relevant + 1)) / n_relevant,
        "adr_self": sum(sum(with_self[:i]) / i for i in range(1, n_relevant + 2))
        / (n_relevant + 1),
        "map": sum(hits(k) / k for k, rel in enumerate(relevant, start=1) if rel) / n_relevant,
    }


def line_distances(order, n):
    """Distances (n, n) in which query 0 ranks the others in the given order, and all other rows are that of index."""
    distances = torch.arange(n, dtype=torch.float64).repeat(n, 1)
    for position, other in enumerate(order, start=1):
        distances[0, other] = position
    return distances


def test_hand_worked_leave_one_out_ranking():
    # Query 0 of class a = {0, 1, 2, 3} among six others ranks: 1 (hit), 4, 2 (hit), 5, 6, 3 (hit), so R = 3.
    labels = ["a", "a", "a", "a", "b", "b", "b"]
    scores = retrieval_scores(
        line_distances([1, 4, 2, 5, 6, 3], 7),
        labels,
    )
    expected = {
        "nn": 1.0,
        "ft": 2 / 3,
        "st": 1.0,
        "e": 2 * 3 / (6 + 3),  # six ranks in all: P = 3/6, recall 1
        "dcg": (1 + 1 / LOG3 + 1 / math.log2(6)) / (1 + 1 + 1 / LOG3),
        "adr": float((Fraction(1, 1) + Fraction(1, 2) + Fraction(2, 3)) / 3),
        "adr_self": float((1 + Fraction(2, 2) + Fraction(2, 3) + Fraction(3, 4)) / 4),
        "map": float((Fraction(1, 1) + Fraction(2, 3) + Fraction(3, 6)) / 3),
    }
    for name, value in expected.items():
        assert getattr(scores, name)[0].item() == pytest.approx(value, abs=1e-12), name


def test_distances_may_be_an_array_as_a_file_gives_them():
    labels = ["a", "a", "a", "a", "b", "b", "b"]
    distances = line_distances([1, 4, 2, 5, 6, 3], 7)
    expected = retrieval_scores(distances, labels).mean()
    assert retrieval_scores(distances.numpy(), labels).mean() == expected
    curve = precision_recall_curve(distances, labels).precision
    assert torch.equal(
        precision_recall_curve(distances.numpy(), labels).precision,
        curve,
    )


def test_another_default_device_changes_no_score():
    labels = ["a", "a", "a", "a", "b", "b", "b"]
    distances = line_distances([1, 4, 2, 5, 6, 3], 7)
    expected = retrieval_scores(distances, labels)
    curve = precision_recall_curve(distances, labels)
    with torch.device("meta"):  # whose tensors have no numbers to go on with
        found = retrieval_scores(distances, labels)
        assert found.mean() == expected.mean()
        assert found.per_class() == expected.per_class()
        assert torch.equal(
            precision_recall_curve(distances, labels).precision,
            curve.precision,
        )


def test_hand_worked_separate_gallery():
    # One query of class 1 against 0, 1, 1, 0, 1 ranked as 0 (miss), 2 (hit), 1 (hit), 3, 4 (hit).
    distances = torch.tensor([[0.1, 0.3, 0.2, 0.4, 0.5]])
    scores = retrieval_scores(
        distances,
        [1],
        [0, 1, 1, 0, 1],
    )
    assert scores.adr_self is None
    assert scores.mean() == pytest.approx(
        {
            "nn": 0.0,
            "ft": 2 / 3,
            "st": 1.0,
            "e": 2 * 3 / (5 + 3),
            "dcg": (1 + 1 / LOG3 + 1 / math.log2(5)) / (2 + 1 / LOG3),
            "adr": (0 + 1 / 2 + 2 / 3) / 3,
            "map": (1 / 2 + 2 / 3 + 3 / 5) / 3,
        },
        abs=1e-12,
    )


@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize(
    ("n", "n_classes"),
    [(12, 3), (90, 2)],
)
def test_agrees_with_loops_over_ranks(n, n_classes, ties):
    distances, labels = random_case(n=n, n_classes=n_classes, seed=n, ties=ties)
    scores = retrieval_scores(distances, labels)
    assert scores.n_queries == n
    for query in range(n):
        expected = scores_by_loops(
            ranked_relevance(
                distances,
                labels.tolist(),
                query,
            )
        )
        found = {name: getattr(scores, name)[query].item() for name in expected}
        assert found == pytest.approx(expected, abs=1e-12)


def test_mean_average_precision_is_that_of_scikit_learn():
    distances, labels = random_case(n=40, n_classes=4, seed=1)
    expected = []
    for query in range(40):
        others = np.arange(40) != query
        is_relevant = (labels == labels[query]).numpy()[others]
        expected.append(average_precision_score(is_relevant, -distances[query].numpy()[others]))
    np.testing.assert_allclose(
        retrieval_scores(distances, labels).map.numpy(), expected, atol=1e-12
    )


def test_perfect_retrieval_scores_one_and_the_worst_misses_all_tiers():
    labels = torch.arange(200).remainder(5)  # 40 a class: R = 39
    same = (labels[:, None] == labels).double()
    perfect = retrieval_scores(1 - same, labels).mean()
    assert perfect.pop("e") == pytest.approx(2 * 32 / (32 + 39))
    assert perfect == pytest.approx(
        dict.fromkeys(perfect, 1.0),
        abs=1e-12,
    )
    worst = retrieval_scores(same, labels).mean()
    assert [worst[name] for name in ("nn", "ft", "st", "e", "adr")] == [0.0] * 5
    # Only the query itself is found
    assert worst["adr_self"] == pytest.approx(sum(1 / i for i in range(1, 41)) / 40)


def test_strings_integers_and_tensors_label_alike():
    distances, labels = random_case(n=20, n_classes=3, seed=7)
    words = [["ant", "bear", "cup"][label] for label in labels]
    expected = retrieval_scores(distances, labels).mean()
    assert retrieval_scores(distances, words).mean() == expected
    assert retrieval_scores(distances, labels.tolist()).mean() == expected
    assert retrieval_scores(distances, labels.numpy()).mean() == expected


def test_a_query_alone_in_its_class_is_left_out_and_counted():
    distances, _ = random_case(n=7, n_classes=1, seed=8)
    labels = ["a", "a", "lonely", "b", "b", "b", "single"]
    scores = retrieval_scores(distances, labels)
    assert scores.n_queries == 5
    assert scores.n_excluded == 2
    assert scores.scored.tolist() == [True, True, False, True, True, True, False]
    for name in SCORE_NAMES:
        assert getattr(scores, name)[[2, 6]].isnan().all()
    relevance = [ranked_relevance(distances, labels, query) for query in (0, 1, 3, 4, 5)]
    loops = [scores_by_loops(relevant) for relevant in relevance]
    expected = {name: sum(values[name] for values in loops) / 5 for name in SCORE_NAMES}
    assert scores.mean() == pytest.approx(expected)


def test_per_class_means_are_those_of_the_members():
    distances, _ = random_case(n=6, n_classes=1, seed=9)
    labels = ["b", "a", "b", "a", "lonely", "a"]
    scores = retrieval_scores(distances, labels)
    per_class = scores.per_class()
    assert list(per_class) == ["b", "a"]
    for label, members in {"a": [1, 3, 5], "b": [0, 2]}.items():
        expected = {name: getattr(scores, name)[members].mean().item() for name in SCORE_NAMES}
        assert per_class[label] == pytest.approx(expected)


@pytest.mark.parametrize("score", [retrieval_scores, precision_recall_curve])
@pytest.mark.parametrize(
    ("distances", "query_labels", "gallery_labels", "message"),
    [
        (torch.ones(2, 3), [0, 0], None, "square for leave-one-out"),
        (torch.tensor([[0.0, float("nan")], [1.0, 0.0]]), [0, 0], None, "NaN"),
        (-torch.eye(2), [0, 0], None, "similarities"),
        (torch.ones(2, 2), [0], None, "query_labels: expected 2 labels"),
        (torch.ones(2, 3), [0, 0], [0, 0], "gallery_labels: expected 3 labels"),
        (
            torch.ones(2, 2),
            [torch.tensor(0), torch.tensor(0)],
            None,
            "query_labels: expected an integer tensor",
        ),
        (
            torch.ones(2, 2),
            torch.tensor([-1, -1]),
            None,
            "query_labels: .* got −1, which means unknown",
        ),
        (torch.ones(2, 2), "aa", None, "query_labels: expected an integer tensor"),
        (
            torch.ones(2, 2),
            [0.5] * 1000,
            None,
            r"got \[0\.5, (0\.5, ){5}\.\.\.\]$",
        ),  # long sequences are cut
        (torch.ones(2, 2), ["a", "b"], None, "nothing to score"),
        (torch.ones(1, 2), ["1"], [1, 1], "nothing to score"),
        (torch.ones(0, 2), [], [1, 1], "nothing to score"),
    ],
)
def test_what_cannot_be_scored_is_refused(score, distances, query_labels, gallery_labels, message):
    with pytest.raises(ValueError, match=message):
        score(distances, query_labels, gallery_labels)


def test_hand_worked_precision_recall_curve():
    # Hits at ranks 1, 3, 4, 6: precisions 1, 2/3, 3/4, 4/6 at recalls 1/4 … 1, the 2/3 lifted to the 3/4 behind it.
    distances = torch.arange(6.0)[None]
    curve = precision_recall_curve(distances, ["a"], list("abaaba"))
    assert curve.precision.tolist() == pytest.approx([1] * 5 + [3 / 4] * 10 + [4 / 6] * 5)
    assert curve.recall.tolist() == [i / 20 for i in range(1, 21)]
    assert curve.n_queries == 1


def test_precision_recall_curve_agrees_with_loops():
    distances, labels = random_case(n=41, n_classes=2, seed=10)
    labels = torch.cat([labels[:-1], torch.tensor([9])])  # the last query has no relevant entry
    curve = precision_recall_curve(distances, labels)
    expected = []
    for level in [i / 20 for i in range(1, 21)]:
        best = []
        for query in range(40):
            relevant = ranked_relevance(distances, labels.tolist(), query)
            n_relevant = sum(relevant)
            hits = 0
            candidates = []
            for k, rel in enumerate(relevant, start=1):
                hits += rel
                if Fraction(hits, n_relevant) >= Fraction(level).limit_denominator(100) and hits:
                    candidates.append(hits / k)
            best.append(max(candidates))
        expected.append(sum(best) / 40)
    assert curve.precision.tolist() == pytest.approx(expected, abs=1e-12)
    assert curve.n_queries == 40


def test_a_recall_level_that_is_a_number_of_hits_is_not_rounded_up():
    # 55 of 100 hits lead, then a miss: the precision at a recall of 0.55 is 1, above it 100/101.
    labels = [1] * 55 + [0] + [1] * 45
    assert 11 / 20 * 100 > 55  # in binary
    curve = precision_recall_curve(
        torch.arange(101.0)[None],
        [1],
        labels,
    )
    assert curve.precision.tolist() == [1.0] * 11 + [100 / 101] * 9


def test_metric_over_batches_is_the_function_over_all():
    generator = torch.Generator().manual_seed(11)
    descriptors = torch.rand(30, 2, 8, generator=generator)
    labels = torch.randint(
        3,
        (30,),
        generator=generator,
    )
    metric = RetrievalScoresMetric(euclidean)
    for start in range(0, 30, 7):
        metric.update(
            descriptors[start : start + 7].requires_grad_(),
            labels[start : start + 7],
        )
    result = metric.compute()
    expected = retrieval_scores(euclidean(descriptors, descriptors).detach(), labels).mean()
    found = {name: value.item() for name, value in result.items()}
    assert found == pytest.approx(expected, abs=1e-6)
    assert tuple(result) == SCORE_NAMES
    for batch in metric.descriptors:
        assert not batch.requires_grad  # no batch keeps its graph alive


def test_metric_compares_by_chi_square_unless_told():
    shapes = torch.tensor([[0.4, 0.0], [0.0, 0.0], [0.2, 0.2]])
    labels = torch.tensor([0, 0, 1])
    metric = RetrievalScoresMetric()
    metric.update(shapes, labels)
    expected = retrieval_scores(chi_square(shapes, shapes), labels).mean()
    assert expected != retrieval_scores(euclidean(shapes, shapes), labels).mean()
    found = {name: value.item() for name, value in metric.compute().items()}
    assert found == pytest.approx(expected)


@pytest.mark.parametrize(
    ("descriptors", "labels"),
    [
        (torch.ones(3, 2), torch.tensor([0, 1])),
        (torch.ones(2, 2), torch.tensor([0.0, 1.0])),
        (torch.ones(2), torch.tensor([0, 1])),
    ],
)
def test_metric_refuses_labels_that_are_not_aligned(descriptors, labels):
    with pytest.raises(ValueError, match="labels: expected one integer for each"):
        RetrievalScoresMetric().update(descriptors, labels)


def seven_shapes():
    descriptors = torch.tensor([0.0, 0.4, 1.1, 1.9, 3.0, 3.2, 5.0])
    return descriptors[:, None], torch.tensor([0, 1, 0, 1, 0, 1, 1])


def test_metric_drops_repetitions_of_one_process():
    descriptors, labels = seven_shapes()
    once = RetrievalScoresMetric(euclidean)
    twice = RetrievalScoresMetric(euclidean)
    once.update(descriptors, labels)
    ids = [str(i) for i in range(7)]
    twice.update(descriptors, labels, ids)
    twice.update(
        descriptors[3:],
        labels[3:],
        ids[3:],
    )
    assert twice.compute() == once.compute()
    twice.reset()
    twice.update(descriptors, labels)
    assert twice.compute() == once.compute()


def test_metric_refuses_names_that_are_not_aligned():
    metric = RetrievalScoresMetric()
    with pytest.raises(ValueError, match="ids: expected one name for each of 2"):
        metric.update(
            torch.ones(2, 2),
            torch.tensor([0, 0]),
            ["a"],
        )
    metric.update(
        torch.ones(2, 2),
        torch.tensor([0, 0]),
        ["a", "b"],
    )
    with pytest.raises(ValueError, match="ids: expected in every update or in none"):
        metric.update(
            torch.ones(2, 2),
            torch.tensor([0, 0]),
        )
    metric.reset()
    metric.update(
        torch.ones(2, 2),
        torch.tensor([0, 0]),
    )
    with pytest.raises(ValueError, match="ids: expected in every update or in none"):
        metric.update(
            torch.ones(2, 2),
            torch.tensor([0, 0]),
            ["a", "b"],
        )


def test_queries_with_one_answer_each_are_scored_by_its_rank():
    """Three left bones ask three right ones: the right one is nearest, second, and third."""
    labels = ["a", "a", "b", "b", "c", "c"]
    is_query = [True, False] * 3
    distances = torch.full((6, 6), 9.0)
    distances[0, [1, 3, 5]] = torch.tensor([1.0, 2.0, 3.0])
    distances[2, [1, 3, 5]] = torch.tensor([1.0, 2.0, 3.0])
    distances[4, [1, 3, 5]] = torch.tensor([1.0, 2.0, 3.0])
    distances[0, 2] = 0.0  # another query: it is not asked
    scores = scores_of_queries(distances, labels, is_query)
    assert scores.has_single_answers
    assert scores.adr_self is None
    found = scores.single_answers()
    assert found["nn"] == pytest.approx(1 / 3)
    assert found["map"] == pytest.approx((1 + 1 / 2 + 1 / 3) / 3)
    assert (found["first_5"], found["median_rank"]) == (1, 2)
    each = scores_of_queries(distances, labels)
    assert each.n_queries == 6
    assert not scores_of_queries(distances, ["a", "a", "a", "b", "b", "b"]).has_single_answers
