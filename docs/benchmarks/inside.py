"""Where a signal lies, in generated bodies whose signal is known, and in hippocampi: the tables of inside.md.

python -m docs.benchmarks.inside patterns
python -m docs.benchmarks.inside power
python -m docs.benchmarks.inside joint
python -m docs.benchmarks.inside hippocampi FOLDER
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jsonargparse import auto_cli
from scipy.spatial import cKDTree
from scipy.stats import norm, rankdata
from training.shapes.bodies import Body, Pose, draw_body, draw_pose
from training.shapes.kinds import BodyClass, body_classes

from igps._arrays import Floats
from igps.analysis.groups import GroupTest, group_test, with_q_values
from igps.analysis.inside import DISTRIBUTION, column_names, has_unit, inside_numbers
from igps.analysis.inside_collection import inside_config, inside_table, standard_scores
from igps.cli import errors_as_messages
from igps.data.attribute_sources import attribute_source
from igps.data.dataset import SignatureDataset
from igps.descriptors import descriptor as descriptor_of
from igps.mesh.mesh import Mesh
from igps.nn.description import describe
from igps.signature.attributes import depth
from igps.signature.signature import Signature, SignatureConfig, compute_signature

PLACES = ("rim", "core", "end", "lumps")
CLASS = "quadruped"
LEVEL = 0.05
FIRST_ORDER = tuple(f"x.{number}" for number in DISTRIBUTION)
COLUMNS = column_names(["x"])
_N_VERTICES = 1500
_N_NEAREST = 24  # vertices that move a point inside with them
_N_WAVES = 50  # of a field of lumps
_WAVELENGTH = 0.4  # about twice the length of a lump; a quadruped is about 2.5 long
_N_DRAWS_OF_NUMBERS = 20  # draws in which each number is tested by itself
_N_PERMUTATIONS = 499  # of joint tests
_NOISE = 0.5  # of each body's own lumps, in standard deviations of its signal


@dataclass(frozen=True)
class Subject:
    """A body with a signal inside, which stays in its place when the body moves."""

    body: Body
    seed: Sequence[int]

    @staticmethod
    def draw(body_class: BodyClass, seed: Sequence[int]) -> Subject:
        """Draw an individual of a class."""
        return Subject(draw_body(body_class, [*seed, 0], [*seed, 1]), seed)

    def posed(self, number: int) -> tuple[Signature, Floats, Mesh]:
        """Return the Signature in a pose, where its P interior samples were at rest (P, 3), and the body at rest."""
        pose = draw_pose(self.body, np.random.default_rng([*self.seed, 2, number]), _N_VERTICES)
        config = inside_config(SignatureConfig(n_surface_samples=100))
        signature = compute_signature(Mesh(pose.bent, pose.faces), config)
        return signature, at_rest(signature.interior.points, pose), Mesh(pose.rest, pose.faces)

    def lumps(self, points: Floats) -> Floats:
        """Return the body's own random field at points at rest (P, 3), as standard scores."""
        random = np.random.default_rng([*self.seed, 3])
        directions = random.normal(size=(_N_WAVES, 3))
        lengths = np.linalg.norm(directions, axis=1, keepdims=True)
        waves = directions / lengths * 2 * np.pi / _WAVELENGTH
        phases = random.uniform(0, 2 * np.pi, _N_WAVES)
        return standardised(np.cos(points @ waves.T + phases).sum(axis=1))

    def signal(self, place: str, points: Floats, rest: Mesh) -> Floats:
        """Return what is high at a place, at points at rest (P, 3), as standard scores."""
        centre = rest.vertices.mean(axis=0)
        longest = np.ptp(rest.vertices, axis=0).argmax()
        side = np.random.default_rng([*self.seed, 4]).choice([-1, 1])
        signals: Mapping[str, Callable[[], Floats]] = {
            "rim": lambda: -depth(rest, points),
            "core": lambda: -np.linalg.norm(points - centre, axis=1),
            "end": lambda: side * points[:, longest],
        }
        return standardised(signals[place]())


def _class() -> BodyClass:
    (found,) = [one for one in body_classes(0) if one.name == CLASS]
    return found


def at_rest(points: Floats, pose: Pose) -> Floats:
    """Return where points (P, 3) of a bent body were at rest, by the rigid motion of the nearest vertices."""
    distance, nearest = cKDTree(pose.bent).query(points, k=_N_NEAREST)
    weights = 1 / np.maximum(distance, 1e-9) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    bent = pose.bent[nearest]
    rest = pose.rest[nearest]
    from_centre = np.einsum("pk,pkd->pd", weights, bent)
    to_centre = np.einsum("pk,pkd->pd", weights, rest)
    covariance = np.einsum(
        "pk,pki,pkj->pij", weights, bent - from_centre[:, None], rest - to_centre[:, None]
    )
    left, _, right = np.linalg.svd(covariance)
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]  # no reflections
    return to_centre + np.einsum("pi,pij->pj", points - from_centre, left @ right)


def standardised(values: Floats) -> Floats:
    """Return values (P,) with mean 0 and standard deviation 1."""
    return (values - values.mean()) / values.std()


def equal_histogram(scores: Floats) -> Floats:
    """Return values in the order of scores (P,), whose histogram is the same in every body."""
    quantiles = (rankdata(scores) - 0.5) / len(scores)
    return np.exp(0.5 * norm.ppf(quantiles))


def numbers_of(signature: Signature, scores: Floats) -> Floats:
    """Return the numbers (columns,) of values in the order of scores (P,)."""
    samples = signature.interior.with_attributes({"x": equal_histogram(scores)})
    numbers = inside_numbers(replace(signature, interior=samples), ["x"])
    return np.array([numbers[name] for name in COLUMNS])


def patterns(n_bodies: int = 200, seed: int = 0) -> None:
    """Print how well numbers tell the place of a signal, and by how much another pose changes them.

    Each body is an individual of one class in a pose of its own. Its signal lies at the rim, in the core, at one end,
    or in lumps, and is mixed with lumps of the body's own. All bodies have the same histogram of values.

    Args:
        n_bodies: number of bodies, the same for each place.
        seed: seed of bodies and poses.
    """
    chosen = _class()
    labels: list[str] = []
    rows: list[list[Floats]] = [[], []]
    for number in range(n_bodies):
        place = PLACES[number % len(PLACES)]
        subject = Subject.draw(chosen, [seed, number])
        for pose in range(2):
            signature, points, rest = subject.posed(pose)
            scores = subject.lumps(points)
            if place != "lumps":
                scores = subject.signal(place, points, rest) + _NOISE * scores
            rows[pose].append(numbers_of(signature, scores))
        labels.append(place)
    first = np.array(rows[0])
    second = np.array(rows[1])
    free = [i for i, name in enumerate(COLUMNS) if not has_unit(name)]
    plain = [COLUMNS.index(name) for name in FIRST_ORDER]
    for title, chosen in (("all numbers without a unit", free), ("first-order", plain)):
        print(f"NN by {title}: {100 * nearest_share(first[:, chosen], labels):.1f} %")
    change = np.abs(first - second) / first.std(axis=0)
    inside = [i for i in range(len(COLUMNS)) if i not in plain]
    for title, chosen in (("all but first-order", inside), ("without a unit", free)):
        of_columns = np.median(change[:, chosen], axis=0)
        print(
            f"change by pose, {title}: median {100 * np.median(change[:, chosen]):.1f} %, "
            f"of columns {100 * of_columns.min():.1f} to {100 * of_columns.max():.1f} %, "
            f"the largest of {COLUMNS[chosen[int(of_columns.argmax())]]}"
        )


def nearest_share(rows: Floats, labels: Sequence[str]) -> float:
    """Return the share of rows whose nearest other row, by standard scores, has the same label."""
    scores = standard_scores(rows)
    squares = np.square(scores[:, None] - scores).sum(axis=2)
    np.fill_diagonal(squares, np.inf)
    names = np.array(labels)
    return float((names[squares.argmin(axis=1)] == names).mean())


def power(n_bodies: int = 200, n_each: int = 30, n_draws: int = 400, seed: int = 1) -> None:
    """Print how often groups that differ only in where the signal lies are told apart.

    The values of a body are in the order of its own lumps plus `a` times the depth, both as standard scores: the larger
    `a`, the nearer to the rim lies the signal. Either `a` is 0 in one group and 0.5 in the other, half a standard
    deviation of the values; or it scatters over bodies by 0.25, and the groups differ by half of that.

    Args:
        n_bodies: bodies in the pool from which both groups are drawn.
        n_each: bodies of a group.
        n_draws: draws of two groups.
        seed: seed of bodies and draws.
    """
    tables = _tables_of_groups(n_bodies, seed)
    for first, second in (("none", "none"), ("none", "values"), ("bodies", "shifted bodies")):
        random = np.random.default_rng([seed, 6])
        found = []
        for draw in range(n_draws):
            drawn = random.permutation(n_bodies)[: 2 * n_each]
            pair = tables[first][drawn[:n_each]], tables[second][drawn[n_each:]]
            has_numbers = draw < _N_DRAWS_OF_NUMBERS
            found.append(rejections(np.vstack(pair), n_each, draw, has_numbers))
        shares = np.nanmean(found, axis=0)
        print(
            f"{first} against {second}: PERMANOVA {shares[0]:.3f}, kernel {shares[1]:.3f}, "
            f"any number with q <= {LEVEL} {shares[2]:.3f}, x.rim.contrast alone {shares[3]:.3f}"
        )


def _tables_of_groups(n_bodies: int, seed: int) -> dict[str, Floats]:
    """Return the numbers (n_bodies, columns) of the same bodies with each signal of `power`."""
    chosen = _class()
    rows: dict[str, list[Floats]] = {"none": [], "values": [], "bodies": [], "shifted bodies": []}
    for number in range(n_bodies):
        subject = Subject.draw(chosen, [seed, number])
        signature, points, rest = subject.posed(0)
        lumps = subject.lumps(points)
        rim = subject.signal("rim", points, rest)
        own = 0.25 * np.random.default_rng([seed, number, 5]).normal()
        for name, strength in zip(rows, (0.0, 0.5, own, own + 0.125), strict=True):
            rows[name].append(numbers_of(signature, lumps + strength * rim))
    return {name: np.array(table) for name, table in rows.items()}


def joint(n_bodies: int = 200, n_each: int = 30, n_draws: int = 400, seed: int = 2) -> None:
    """Print how often several joint tests tell groups apart that differ by half a standard deviation between bodies.

    Args:
        n_bodies: bodies in the pool from which both groups are drawn.
        n_each: bodies of a group.
        n_draws: draws of two groups.
        seed: seed of bodies; another one than that of `power`.
    """
    tables = _tables_of_groups(n_bodies, seed)
    free = [i for i, name in enumerate(COLUMNS) if not has_unit(name)]
    signs = np.repeat([1.0, -1.0], n_each)
    for first, second in (("none", "none"), ("bodies", "shifted bodies")):
        random = np.random.default_rng(6)
        rejected: dict[str, list[bool]] = {}
        for _ in range(n_draws):
            drawn = random.permutation(n_bodies)[: 2 * n_each]
            pair = tables[first][drawn[:n_each]], tables[second][drawn[n_each:]]
            rows = standard_scores(np.vstack(pair)[:, free])
            groups = [signs, *(random.permutation(signs) for _ in range(_N_PERMUTATIONS))]
            for name, values in joint_statistics(rows, np.array(groups)).items():
                is_found = np.mean(values >= values[0] - 1e-12) <= LEVEL
                rejected.setdefault(name, []).append(bool(is_found))
        shares = ", ".join(f"{name} {np.mean(found):.3f}" for name, found in rejected.items())
        print(f"{first} against {second}: {shares}")


def joint_statistics(rows: Floats, groups: Floats) -> dict[str, Floats]:
    """Return statistics (P,) by name of rows (N, D), for groups (P, N) of signs; larger tells of a difference."""
    n = len(rows)
    names = [name for name in COLUMNS if not has_unit(name)]
    shift = groups @ rows * 2 / n  # of the means
    variance = (np.square(rows).sum(axis=0) - n / 4 * np.square(shift)) / (n - 2)
    t = shift / np.sqrt(variance * 4 / n)
    at_rim = [i for i, name in enumerate(names) if ".rim." in name]
    _, axes = np.linalg.eigh(rows.T @ rows)
    scores = rows @ axes[:, -1]
    return {
        "sum of squares": np.square(shift).sum(axis=1),
        "largest t": np.abs(t).max(axis=1),
        "Hotelling, all": _hotelling(rows, shift),
        "Hotelling, rim": _hotelling(rows[:, at_rim], shift[:, at_rim]),
        "first principal component": np.abs(groups @ scores),
        "rim.contrast": np.abs(t[:, names.index("x.rim.contrast")]),
    }


def _hotelling(rows: Floats, shift: Floats) -> Floats:
    """Return Hotelling's T² up to a factor, with a ridge of a tenth of the mean variance."""
    covariance = rows.T @ rows / len(rows)
    precision = np.linalg.inv(covariance + 0.1 * np.eye(len(covariance)))
    return np.einsum("pi,ij,pj->p", shift, precision, shift)


def rejections(rows: Floats, n_each: int, seed: int, has_numbers: bool) -> list[float]:
    """Return whether two groups are told apart: by all numbers and two tests, by any number, by the contrast."""
    free = [i for i, name in enumerate(COLUMNS) if not has_unit(name)]
    joint = _tested(standard_scores(rows[:, free]), n_each, seed)
    contrast = _tested(rows[:, [COLUMNS.index("x.rim.contrast")]], n_each, seed)
    any_number = np.nan
    if has_numbers:
        tests = with_q_values([_tested(rows[:, [i]], n_each, seed) for i in free])
        any_number = float(min(test.permanova_q or 1.0 for test in tests) <= LEVEL)
    p_values = (joint.permanova_p, joint.kernel_p, contrast.permanova_p)
    permanova, kernel, of_contrast = (float((p or 1.0) <= LEVEL) for p in p_values)
    return [permanova, kernel, any_number, of_contrast]


def _tested(vectors: Floats, n_each: int, seed: int) -> GroupTest:
    groups = ["a"] * n_each + ["b"] * n_each
    return group_test(vectors, groups, n_permutations=499, n_bootstraps=0, n_repeats=0, seed=seed)


def hippocampi(folder: Path, cache_dir: Path, seed: int = 0) -> None:
    """Print the area under the curve by which the anterior half of a hippocampus is told from the posterior.

    Args:
        folder: with `masks` (1 anterior, 2 posterior) and `mr`, of the same names.
        cache_dir: folder of the cache.
        seed: seed of the five splits of the subjects into halves for training and test.
    """
    paths = sorted((folder / "masks").glob("*.nii.gz"))
    sources = {"mr": attribute_source(f"{(folder / 'mr').resolve()}/{{stem}}.nii.gz")}
    config = inside_config(SignatureConfig())
    dataset = SignatureDataset(paths, config, cache_dir, attributes=sources)
    dataset = dataset.usable(dataset.precompute())
    form = descriptor_of("pretrained")
    shapes = SignatureDataset(dataset.bodies, cache_dir=cache_dir, descriptor=form)
    shapes.precompute(strict=True)
    vectors = form.coordinates(describe(shapes, form)).double().numpy()
    table = inside_table(dataset, ["mr"])
    free = [i for i, name in enumerate(table.columns) if not has_unit(name)]
    plain = table.rows[:, : len(DISTRIBUTION)]
    inside = table.rows[:, free]
    subjects = np.array([path.name for path in dataset.bodies.paths])
    is_anterior = np.array([part == "1" for part in dataset.bodies.parts])
    print(f"{len(subjects)} bodies of {len(set(subjects))} subjects")
    chosen = {
        "form": [vectors],
        "first-order values": [plain],
        "inside, without a unit": [inside],
        "form and first-order values": [vectors, plain],
        "form, first-order values and inside": [vectors, plain, inside],
    }
    for title, columns in chosen.items():
        areas = areas_under_curve(np.hstack(columns), is_anterior, subjects, seed)
        print(f"{title}: AUC {np.mean(areas):.3f} ± {np.std(areas, ddof=1):.3f}")


def areas_under_curve(
    rows: Floats, is_first: np.ndarray, subjects: np.ndarray, seed: int
) -> list[float]:
    """Return the areas under the curve of a ridge logistic regression, for five splits of the subjects into halves."""
    from sklearn.linear_model import LogisticRegression
    from sklearn.metrics import roc_auc_score
    from sklearn.model_selection import GroupShuffleSplit
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    areas = []
    splits = GroupShuffleSplit(n_splits=5, test_size=0.5, random_state=seed)
    for training, test in splits.split(rows, is_first, subjects):
        model = make_pipeline(StandardScaler(), LogisticRegression(C=0.1, max_iter=2000))
        model.fit(rows[training], is_first[training])
        scores = model.decision_function(rows[test])
        areas.append(float(roc_auc_score(is_first[test], scores)))
    return areas


if __name__ == "__main__":
    with errors_as_messages():
        auto_cli([patterns, power, joint, hippocampi])
