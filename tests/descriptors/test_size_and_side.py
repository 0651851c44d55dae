"""Size and side beside form: by hand-worked distances, scaled bodies and mirror images."""

import zipfile
from functools import partial

import numpy as np
import pytest
import torch
import trimesh
from numpy.linalg import det, norm, qr
from torch.testing import assert_close

import igps
from igps import Mesh, SignatureConfig, collate, compute_signature
from igps.cli.compare_command import compare
from igps.cli.duplicates_command import duplicates as list_duplicates
from igps.cli.gallery_commands import build
from igps.cli.retrieval_commands import query, retrieve
from igps.descriptors.fingerprint import cache_tag
from igps.descriptors.size_and_side import SCALES, SizeAndSide, keeps_size, signed_volumes
from igps.duplicates.duplicates import duplicates
from igps.gallery.gallery import Gallery
from igps.nn.descriptor import EmbeddedDescriptor

CONFIG = SignatureConfig(
    n_eigenpairs=250, attributes=("depth", "electrostatic_potential", "surface_direction")
)
SURFACE = trimesh.creation.icosphere(subdivisions=3)


def twisted(turns, scale=1.0, unit=None, mirrored=False):
    """An ellipsoid whose flat side turns along its axis, which is no mirror image of itself."""
    x, y, z = (SURFACE.vertices * [1.4, 0.6, 2.2]).T
    angle = turns * z
    across = np.cos(angle) * x - np.sin(angle) * y
    beside = np.sin(angle) * x + np.cos(angle) * y
    points = scale * np.stack([across, beside, z], axis=1)
    if mirrored:
        return Mesh(
            points * [1, -1, 1],
            SURFACE.faces[:, ::-1],
            unit=unit,
        )
    return Mesh(points, SURFACE.faces, unit=unit)


@pytest.fixture(scope="module")
def signatures():
    bodies = {
        "body": twisted(0.5, unit="mm"),
        "centimetres": twisted(0.5, 0.1, "cm"),
        "larger": twisted(0.5, 1.1, "mm"),
        "mirrored": twisted(0.5, unit="mm", mirrored=True),
        "straight": twisted(0.0, unit="mm"),
    }
    return {name: compute_signature(body, CONFIG) for name, body in bodies.items()}


def from_body(name, signatures):
    """The distances from the first body by a descriptor."""
    descriptor = igps.descriptor(name)
    descriptions = torch.cat([descriptor(collate([one])) for one in signatures.values()])
    distances = descriptor.distances(descriptions[:1], descriptions)[0].tolist()
    return dict(zip(signatures, distances, strict=True))


@pytest.mark.parametrize("name", ["interior", "pretrained"])
def test_distances_with_size_are_those_of_the_formula(name, signatures):
    plain = from_body(name, signatures)
    sized = from_body(f"{name}+size", signatures)
    for other in ("body", "centimetres", "mirrored"):
        assert sized[other] == pytest.approx(
            plain[other],
            rel=1e-2,
            abs=1e-3 * SCALES[name],
        )
    apart = 5 * np.log(1.1)  # in log area and in log volume
    n = SCALES[name] / 4
    expected = plain["larger"] + (plain["larger"] + n) * apart / 0.5
    assert sized["larger"] == pytest.approx(expected, rel=1e-3)


def test_vectors_count_a_small_difference_in_size_as_distances_do(signatures):
    descriptor = igps.descriptor("interior", size="keep")
    body = descriptor(collate([signatures["body"]]))
    other = body.clone()
    other[:, -1] += 1e-6
    # The slope at nothing, along one of the two numbers.
    expected = float((body - other).norm())
    found = float(descriptor.distances(body, other))
    assert found == pytest.approx(expected, rel=1e-2)


def test_short_vectors_keep_the_numbers_of_size_and_side(signatures):
    descriptor = igps.descriptor("pretrained+side+size")
    vectors = descriptor(collate(list(signatures.values())))
    short = descriptor.shorten(vectors)
    assert short.shape[1] == 256 + 55
    assert_close(short[:, -55:], vectors[:, -55:])
    with pytest.raises(ValueError, match="shorten: expected a descriptor of vectors"):
        igps.descriptor("rich+size").shorten(vectors)


@pytest.mark.parametrize("name", ["interior", "rich"])
def test_a_mirror_image_is_the_body_unless_it_is_distinct(name, signatures):
    same = from_body(name, signatures)
    distinct = from_body(f"{name}+side", signatures)
    assert same["mirrored"] < 0.1 * SCALES[name]
    assert distinct["mirrored"] > SCALES[name] / 2
    assert distinct["larger"] < 0.2 * distinct["mirrored"]  # to sampling noise the body itself


def test_twists_of_a_mirror_image_have_the_other_sign_and_a_symmetric_body_has_none(signatures):
    descriptor = igps.descriptor("interior", mirror="distinct")
    odd = {name: descriptor(collate([one]))[0, -18:] for name, one in signatures.items()}
    assert float((odd["body"] + odd["mirrored"]).norm()) < 0.15 * float(odd["body"].norm())
    assert float(odd["straight"].norm()) < 0.2 * float(odd["body"].norm())


def test_a_body_that_is_turned_is_far_nearer_than_its_mirror_image():
    """Of a ball with a dozen smooth bumps and dents, whose sides differ little."""
    random = np.random.default_rng(3)
    ball = SURFACE.vertices
    middles = random.normal(size=(12, 3))
    middles /= norm(middles, axis=1, keepdims=True)
    squares = ((ball[:, None] - middles) ** 2).sum(axis=2)
    heights = np.exp(-squares / random.uniform(0.1, 0.5, 12)) @ random.uniform(-0.3, 0.7, 12)
    body = ball * (1 + heights)[:, None] * [1, 1.3, 0.8]
    turn = qr(random.normal(size=(3, 3)))[0]
    turn *= det(turn)
    # Turned outwards again
    meshes = [Mesh(body @ one, SURFACE.faces) for one in (np.eye(3), turn, -np.eye(3), -turn)]
    descriptor = igps.descriptor("interior+side")
    found = descriptor(collate([compute_signature(one, CONFIG) for one in meshes]))
    _, turned, *mirrored = descriptor.distances(found[:1], found)[0].tolist()
    assert turned < min(mirrored) / 3


def bent(mirrored=False, turn=None):
    """A limb that grows thicker and bends to one side, and to another at its end."""
    x, y, z = SURFACE.vertices.T
    wide = 0.45 * (1 + 0.5 * z)
    along = 2 * z
    across = wide * x + 0.35 * along**2
    beside = wide * y + 0.6 * np.maximum(along, 0) ** 2
    points = np.stack([across, beside, along], axis=1)
    if mirrored:
        return Mesh(
            points * [1, 1, -1],
            SURFACE.faces[:, ::-1],
        )
    return Mesh(
        points if turn is None else points @ turn.T * 3 + 5,
        SURFACE.faces,
    )


def test_signed_volumes_turn_their_signs_with_a_mirror_image_and_are_blind_to_motion_scale_and_padding():
    turn = qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= det(turn)
    meshes = (bent(), bent(True), bent(turn=turn), twisted(0.0))
    made = [compute_signature(one, CONFIG) for one in meshes]
    found = signed_volumes(collate(made))
    alone = torch.cat([signed_volumes(collate([one])) for one in made])
    assert_close(found, alone, atol=1e-6, rtol=0)
    assert float((found[0] + found[1]).norm()) < 0.1 * float(found[0].norm())
    assert float((found[0] - found[2]).norm()) < 0.1 * float(found[0].norm())
    # Its three planes of symmetry leave it nothing but where samples lie
    assert float(found[3].norm()) < 0.1 * float(found[0].norm())


def test_a_signed_volume_is_that_of_its_three_vectors():
    """Of the interior and of the surface by distance, and of the surface by heat: written down for one body."""
    signature = compute_signature(bent(), CONFIG)
    inside, outside = (
        (one.points - one.points.mean(axis=0, dtype=float)) / np.sqrt(signature.area)
        for one in (signature.interior, signature.surface)
    )
    decay = np.exp(-0.01 * signature.area * signature.eigenvalues[:16])
    heat = np.square(signature.surface.eigenfunctions[:, :16].astype(float)) @ decay
    by_distance = norm(inside, axis=1) @ inside / len(inside)
    of_surface = norm(outside, axis=1) @ outside / len(outside)
    by_heat = heat / heat.mean() @ outside / len(outside)
    three = np.stack([by_distance, of_surface, by_heat])
    expected = det(three) / norm(three, axis=1).prod() ** (2 / 3)
    assert abs(expected) > 1e-4
    assert float(signed_volumes(collate([signature]))[0, 0]) == pytest.approx(expected, rel=1e-3)


def test_names_carry_the_choice():
    assert igps.descriptor("rich", size="keep", mirror="distinct").name == "rich+side+size"
    assert igps.descriptor("rich+size", mirror="distinct").name == "rich+side+size"
    assert igps.descriptor("rich", size="auto", units=["mm", "Å"]).name == "rich+size"
    assert igps.descriptor("rich", size="auto", units=["mm", None]).name == "rich"
    assert igps.descriptor("gps+size").invariant_to == ("motion", "pose")
    assert igps.descriptor("gps+side").invariant_to == ("scale", "pose")
    tags = {cache_tag(igps.descriptor(name)) for name in ("gps", "gps+size", "gps+side")}
    assert len(tags - {None}) == 3


def test_what_cannot_be_weighed_is_refused():
    with pytest.raises(
        ValueError, match=r"size: expected .* or \"auto\" with the units of the bodies"
    ):
        igps.descriptor("gps", size="auto")
    with pytest.raises(ValueError, match="mirror: expected one of same, distinct, got 'different'"):
        igps.descriptor("gps", mirror="different")
    with pytest.raises(ValueError, match="size: expected one of auto, keep, ignore, got True"):
        igps.descriptor("gps", size=True)
    with pytest.raises(ValueError, match="size: expected one of auto, keep, ignore, got 'kept'"):
        keeps_size("kept", ["mm"])
    with pytest.raises(
        ValueError, match=r"expected \+NAME or \+NAME=WEIGHT .*got 'gps\+colour=red'"
    ):
        igps.descriptor("gps+colour=red")
    with pytest.raises(
        ValueError, match=r"expected \+NAME or \+NAME=WEIGHT .*got 'gps\+ct=1\.5\.2'"
    ):
        igps.descriptor("gps+ct=1.5.2")
    with pytest.raises(
        ValueError, match="expected a descriptor that ignores size by itself, got 'molecular'"
    ):
        igps.descriptor("molecular", size="keep")
    own = igps.descriptor("gps")
    own.name = "own"
    with pytest.raises(ValueError, match="Set its attribute `scale`"):
        igps.descriptor(own, size="keep")
    own.scale = 0.02
    assert igps.descriptor(own, size="keep").name == "own+size"


@pytest.mark.parametrize(
    ("size", "units", "expected", "told"),
    [
        ("auto", ["mm", "cm"], True, ""),
        ("auto", [None, None], False, ""),
        ("auto", ["mm", None], False, "size is ignored: 1 of 2 bodies have no unit of length; if"),
        ("auto", ["mm", "furlong"], False, "size is ignored: 1 of 2"),
        ("keep", [None, None], True, ""),
        (
            "keep",
            ["mm", None],
            True,
            "size is kept: 1 of 2 bodies have no unit of length; their coordinates are",
        ),
        ("ignore", ["mm", "mm"], False, ""),
    ],
)
def test_size_is_kept_where_there_are_units(size, units, expected, told):
    kept, sentence = keeps_size(size, units)
    assert kept is expected
    assert sentence.startswith(told)
    assert bool(sentence) is bool(told)


def write_3mf(path, radius, unit, body=SURFACE):
    """A ball of a radius in a unit, or another body so many times as large."""
    points = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in body.vertices * radius)
    faces = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in body.faces)
    mesh = f"<mesh><vertices>{points}</vertices><triangles>{faces}</triangles></mesh>"
    space = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "3D/3dmodel.model",
            f'<model unit="{unit}" xmlns="{space}"><resources><object id="1">{mesh}</object></resources>'
            '<build><item objectid="1"/></build></model>',
        )


def test_balls_of_one_size_find_each_other_in_whatever_unit(tmp_path, capsys):
    root = tmp_path / "balls"
    for name, radius, unit in (
        ("1/a", 1, "inch"),
        ("1/b", 25.4, "millimeter"),
        ("2/c", 28, "millimeter"),
        ("2/d", 2.8, "centimeter"),
    ):
        write_3mf(root / f"{name}.3mf", radius, unit)
    options = {"cache_dir": tmp_path / "cache", "n_workers": 1}
    summary = retrieve(root, "shape_dna", **options)
    assert summary["config"]["descriptor"] == "shape_dna+size"
    assert summary["nn"] == 1
    plain = retrieve(root, "shape_dna", size="ignore", **options)
    assert plain["config"]["descriptor"] == "shape_dna"
    by_dna = igps.descriptor("shape_dna")
    dataset = igps.SignatureDataset(root, cache_dir=tmp_path / "cache", descriptor=by_dna)
    assert dataset.units() == ["in", "mm", "mm", "cm"]
    Gallery.build(tmp_path / "index", dataset, "shape_dna+size", n_workers=1)
    found = query(
        root / "1/a.3mf",
        gallery=tmp_path / "index",
        top=2,
        cache_dir=tmp_path / "cache",
    )
    assert [row["name"] for row in found] == ["1/a.3mf", "1/b.3mf"]
    with pytest.raises(
        ValueError,
        match=r"expected a gallery with descriptor \"shape_dna\", got \"shape_dna\+size\"",
    ):
        query(
            root / "1/a.3mf",
            gallery=tmp_path / "index",
            size="ignore",
            cache_dir=tmp_path / "cache",
        )
    retrieve(root, "own_descriptors:Height", size="keep", **options)
    assert "has no effect: own_descriptors:Height does not declare" in capsys.readouterr().out
    retrieve(root, "own_descriptors:Height", size="ignore", **options)
    assert "has no effect: own_descriptors:Height does not declare" in capsys.readouterr().out
    SURFACE.export(root / "2/e.off")
    retrieve(root, "shape_dna", **options)
    assert "size is ignored: 1 of 5 bodies have no unit of length" in capsys.readouterr().out
    query(root / "2/e.off", gallery=tmp_path / "index", cache_dir=tmp_path / "cache")
    assert (
        "size is kept: 1 of 1 bodies have no unit; their coordinates are taken as millimetres"
        in capsys.readouterr().out
    )
    query(root / "2/c.3mf", gallery=tmp_path / "index", cache_dir=tmp_path / "cache")
    assert "no unit" not in capsys.readouterr().out


def test_copies_of_another_size_are_no_duplicates_where_size_counts(tmp_path, capsys):
    for name, factor, unit in (
        ("a", 1, "inch"),
        ("b", 25.4, "millimeter"),
        ("c", 30, "millimeter"),
    ):
        write_3mf(tmp_path / f"{name}.3mf", factor, unit, twisted(0.5))
    dataset = igps.SignatureDataset(
        tmp_path, cache_dir=tmp_path / "cache", descriptor=igps.descriptor("pretrained")
    )
    assert duplicates(dataset, n_workers=1).groups == (("a.3mf", "b.3mf"),)
    [group] = duplicates(dataset, size="ignore", n_workers=1).groups
    assert set(group) == {"a.3mf", "b.3mf", "c.3mf"}
    SURFACE.export(tmp_path / "ball.off")  # without a unit, so that no size counts
    found = list_duplicates(tmp_path, cache_dir=tmp_path / "cache", n_workers=1)
    assert found["groups"] == [["a.3mf", "b.3mf", "c.3mf"]]
    assert "size is ignored: 1 of 4 bodies have no unit of length" in capsys.readouterr().out


def test_a_head_is_fitted_to_form_with_size_beside_it_and_travels_in_a_file(tmp_path):
    shapes = igps.ArticulatedShapes(n_classes=2, n_per_class=4, n_vertices=600)
    shapes.write(tmp_path / "shapes")
    dataset = igps.SignatureDataset(
        tmp_path / "shapes",
        cache_dir=tmp_path / "cache",
        descriptor=igps.descriptor("interior+side"),
    )
    model = igps.fit(dataset, "interior+side+size", head="whitened", n_workers=1)
    assert isinstance(model, SizeAndSide)
    assert isinstance(model.descriptor, EmbeddedDescriptor)
    assert model.scale == pytest.approx(model.card["scale"])
    model.save(tmp_path / "mine.safetensors")
    batch = dataset.batch(range(8))
    loaded = igps.descriptor(tmp_path / "mine.safetensors")
    again = igps.descriptor(f"{tmp_path}/mine.safetensors+size", mirror="distinct")
    assert again.name == loaded.name
    described = loaded(batch)
    assert_close(described, model(batch))
    assert_close(loaded.distances(described, described), model.distances(described, described))


@pytest.mark.parametrize(
    ("command", "name", "options"),
    [
        ("retrieve", "d2+size", {"size": "ignore"}),
        ("compare", "d2+side", {"mirror": "same"}),
        ("gallery build", "kept.safetensors", {"size": "ignore"}),
    ],
)
def test_a_name_that_contradicts_an_option_is_refused_before_anything_is_computed(
    command, name, options, tmp_path, here, nothing_is_computed
):
    write_3mf(tmp_path / "balls" / "1" / "a.3mf", 1, "inch")
    igps.descriptor("d2+size").save(tmp_path / "kept.safetensors", {})
    root = tmp_path / "balls"
    run = {
        "retrieve": partial(retrieve, root, name),
        "compare": partial(compare, root, [name, "shape_dna"]),
        "gallery build": partial(build, root, tmp_path / "gallery", name),
    }[command]
    with pytest.raises(
        ValueError, match=rf"{next(iter(options))}: expected no .* with d2\+si[zd]e"
    ):
        run(**options)


def test_a_descriptor_is_compared_with_itself_that_keeps_size(tmp_path):
    for name, radius in (("1/a", 1), ("1/b", 1.1), ("2/c", 3), ("2/d", 3.3)):
        write_3mf(tmp_path / "balls" / f"{name}.3mf", radius, "inch")
    rows = compare(
        tmp_path / "balls",
        ["shape_dna", "shape_dna+size"],
        cache_dir=tmp_path / "cache",
        n_workers=1,
    )
    assert [row["descriptor"] for row in rows] == ["shape_dna", "shape_dna+size"]
    assert rows[1]["nn"] == 1
    with pytest.raises(ValueError, match="expected different names, got shape_dna more than once"):
        compare(tmp_path / "nowhere", ["shape_dna", "shape_dna+size"], size="keep")


def test_coordinates_keep_size_beside_those_of_the_descriptor(signatures):
    sized = igps.descriptor("interior+size")
    descriptions = sized(collate([signatures["body"], signatures["larger"]]))
    rows = sized.coordinates(descriptions)
    form = igps.descriptor("interior")(collate([signatures["body"]])).flatten()
    assert_close(rows[0, :-2], form.sqrt())
    assert rows[:, -2:].equal(descriptions[:, -2:])
