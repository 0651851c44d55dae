import csv

import numpy as np
import pytest
import trimesh
from matplotlib.image import imread

from igps.report import drawing


@pytest.fixture
def root(tmp_path):
    for label, ratio in (("ball", 1.0), ("egg", 2.0)):
        for i in range(2):
            body = trimesh.creation.icosphere(subdivisions=2)
            body.vertices *= [1, 1, ratio + 0.1 * i]
            path = tmp_path / label / f"{i}.off"
            path.parent.mkdir(parents=True, exist_ok=True)
            body.export(path)
    names = ["ball/0.off", "ball/1.off", "egg/0.off", "egg/1.off"]
    with (tmp_path / "ranking.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["query", "rank", "model", "distance", "relevant"])
        for query in names:
            for place, model in enumerate([name for name in names if name != query], 1):
                writer.writerow([query, place, model, place / 10, int(query[:3] == model[:3])])
    return tmp_path


def test_ranked_results_show_each_class_with_hits_and_misses(root, figures_of):
    made = figures_of(drawing)
    drawing.ranked_results(root, root / "ranking.csv", root / "out" / "ranked.png", top=3)
    axes = np.array(made[0].axes).reshape(2, 4)
    titles = [[axis.get_title() for axis in row] for row in axes]
    assert titles[0] == [
        "query ball/0.off",
        "ball/1.off\n0.100",
        "egg/0.off\n0.200",
        "egg/1.off\n0.300",
    ]
    assert titles[1][0] == "query egg/0.off"
    styles = [[axis.spines["top"].get_linestyle() for axis in row] for row in axes]
    assert styles == [["-", "-", "--", "--"], ["-", "--", "--", "-"]]
    for axis in axes.flat:
        assert axis.images[0].get_array()[..., 3].mean() > 0.05
    assert imread(root / "out" / "ranked.png").std() > 0.05


def test_a_ball_is_a_disc_lit_by_its_normals():
    ball = trimesh.creation.icosphere(subdivisions=3)
    picture = drawing.shaded(ball.vertices, ball.faces, 64)
    row, column = np.indices((64, 64))
    radius = 63 / 2 / 1.08
    x = (column - 31.5) / radius
    y = (31.5 - row) / radius
    from_centre = np.hypot(x, y)
    assert (picture[from_centre < 0.96, 3] == 1).all()
    assert (picture[from_centre > 1.04, 3] == 0).all()
    inside = from_centre < 0.9
    z = np.sqrt(1 - from_centre[inside] ** 2)
    expected = np.clip(0.35 + 0.6 * (0.35 * x[inside] + 0.45 * y[inside] + 0.82 * z), 0, 1)
    found = picture[inside, 0]
    np.testing.assert_allclose(found, expected * drawing.GREY[0], atol=0.04)


def test_turned_body_is_drawn_alike():
    body = trimesh.creation.cone(radius=0.4, height=2.0, sections=24)
    turned = body.vertices @ trimesh.transformations.rotation_matrix(2.0, [1, 2, 3])[:3, :3].T
    straight = drawing.front_view(body.vertices)
    back = drawing.front_view(turned)
    found = np.ptp(back, axis=0)[1]
    expected = np.ptp(straight, axis=0)[1]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    for view in (straight, back):
        tip = view[np.argmax(np.linalg.norm(view - view.mean(axis=0), axis=1))]
        assert tip[1] == pytest.approx(view[:, 1].max())  # the slender end is up


def test_view_is_no_mirror_image():
    points = np.random.default_rng(0).random((50, 3)) * [1, 2, 3]
    frame = np.linalg.lstsq(points, drawing.front_view(points), rcond=None)[0]
    assert np.linalg.det(frame) == pytest.approx(1)
