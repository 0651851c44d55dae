from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import torch
import trimesh
from numpy.testing import assert_array_equal
from torch.testing import assert_close
from torch.utils.data import DataLoader, Dataset

from batches import two_bodies
from igps.data.batch import LabelledSignature, SampleBatch, SignatureBatch
from igps.data.collation import collate
from igps.mesh.mesh import Mesh
from igps.signature.signature import Samples, Signature, SignatureConfig


def samples(generator, n_points, n_eigenpairs):
    functions = generator.standard_normal((n_points, n_eigenpairs)).astype(np.float32)
    attributes = {"depth": generator.random(n_points).astype(np.float32)}
    attributes["surface_direction"] = generator.standard_normal((n_points, 3)).astype(np.float32)
    return Samples(generator.random((n_points, 3)) * 3 + 5, functions, attributes)


@pytest.fixture
def signatures():
    """Three, of different numbers of samples and of eigenpairs."""
    generator = np.random.default_rng(0)
    return [
        Signature(
            np.cumsum(generator.random(n_eigenpairs) + 1),
            samples(generator, n_points, n_eigenpairs),
            samples(generator, 9 - i, n_eigenpairs),
            area=2.0 + i,
            volume=0.5 + i,
            config=SignatureConfig(n_eigenpairs=n_eigenpairs),
            name=f"body {i}",
        )
        for i, (n_points, n_eigenpairs) in enumerate([(12, 5), (7, 8), (15, 3)])
    ]


def centred(signature, room):
    points = getattr(signature, room).points
    return points - points.mean(axis=0)


def test_bodies_are_the_signatures_without_padding(signatures):
    batch = collate(signatures)
    assert batch.eigenvalues.shape == (3, 8)
    assert batch.interior.points.shape == (3, 15, 3)
    bodies = list(batch.bodies())
    for body, signature in zip(bodies, signatures, strict=True):
        assert body.id == signature.name
        assert body.area == signature.area
        assert body.volume == signature.volume
        assert body.eigenvalues.dtype == np.float64
        assert_array_equal(body.eigenvalues, signature.eigenvalues)
        for room in ("interior", "surface"):
            found = getattr(body, room)
            expected = getattr(signature, room)
            np.testing.assert_allclose(found.points, centred(signature, room), atol=1e-6)
            assert_array_equal(found.eigenfunctions, expected.eigenfunctions)
            assert found.attributes.keys() == expected.attributes.keys()
            for name, values in expected.attributes.items():
                assert_array_equal(found.attributes[name], values)


def test_padding_is_marked(signatures):
    batch = collate(signatures)
    assert batch.interior.mask.sum(dim=1).tolist() == [12, 7, 15]
    assert torch.isfinite(batch.eigenvalues).sum(dim=1).tolist() == [5, 8, 3]
    assert (batch.eigenvalues[~torch.isfinite(batch.eigenvalues)] > 0).all()
    for part in (batch.interior, batch.surface):
        for values in (part.points, part.eigenfunctions, *part.attributes.values()):
            assert (values[~part.mask] == 0).all()


def test_labels_and_names(signatures):
    items = [
        LabelledSignature(signatures[0], 4, "a"),
        LabelledSignature(signatures[2], 0, "b"),
        signatures[1],
    ]
    batch = collate(items)
    assert batch.labels.tolist() == [4, 0, -1]
    assert batch.ids == ("a", "b", "body 1")
    assert len(batch) == 3


def test_meshes_go_with_their_bodies(signatures):
    box = trimesh.creation.box()
    meshes = [
        Mesh(
            np.asarray(box.vertices) * s,
            np.asarray(box.faces),
            name=str(s),
        )
        for s in (1.0, 2.0, 3.0)
    ]
    batch = collate(signatures, meshes)
    assert batch.meshes == tuple(meshes)
    assert [body.mesh for body in batch.bodies()] == meshes
    assert batch.to("cpu").meshes == tuple(meshes)
    (first, *_) = collate(signatures).bodies()
    assert first.surface_mesh is None
    with pytest.raises(ValueError, match="body 0: expected a batch with meshes, got one without"):
        _ = first.mesh
    with pytest.raises(ValueError, match="meshes: expected one for each of 3 signatures, got 2"):
        collate(signatures, meshes[:2])


def test_points_are_centred_before_they_lose_digits():
    generator = np.random.default_rng(1)
    near = samples(generator, 20, 2)
    far = replace(near, points=near.points + 1e6)
    whole = Signature(
        np.array([1.0, 2.0]),
        near,
        near,
        1.0,
        1.0,
        SignatureConfig(n_eigenpairs=2),
    )
    batch = collate([whole, replace(whole, interior=far, surface=far)])
    assert_close(
        batch.interior.points[0],
        batch.interior.points[1],
        atol=1e-6,
        rtol=0,
    )
    np.testing.assert_allclose(batch.interior.points.mean(dim=1), 0, atol=1e-6)


def test_nothing_and_unlike_attributes_are_refused(signatures):
    with pytest.raises(ValueError, match="at least one"):
        collate([])
    bare = replace(signatures[0].interior, attributes={})
    words = r"must carry the same, got \['depth', 'surface_direction'\] and \[\]"
    with pytest.raises(ValueError, match=words):
        collate([signatures[1], replace(signatures[0], interior=bare)])


def of_samples(batch, i):
    rows = torch.cat([batch.points[i], batch.eigenfunctions[i]], dim=1)[batch.mask[i]]
    return {tuple(row) for row in rows.tolist()}


@pytest.mark.parametrize("seed", [None, 0])
def test_subset_takes_real_samples_each_once(signatures, seed):
    batch = collate(signatures).interior
    some = batch.subset(10, seed)
    assert some.mask.sum(dim=1).tolist() == [10, 7, 10]
    for i, n in enumerate((10, 7, 10)):
        assert len(of_samples(some, i)) == n
        assert of_samples(some, i) <= of_samples(batch, i)
        for name, values in some.attributes.items():
            places = batch.points[i].tolist()
            order = [places.index(point) for point in some.points[i, some.mask[i]].tolist()]
            assert torch.equal(
                values[i, some.mask[i]],
                batch.attributes[name][i, order],
            )
    assert (some.eigenfunctions[~some.mask] == 0).all()


def test_subset_with_a_seed_depends_on_nothing_but_the_shape(signatures):
    together = collate(signatures).interior.subset(6, seed=3)
    for i, signature in enumerate(signatures):
        single = collate([signature]).interior.subset(6, seed=3)
        width = single.eigenfunctions.shape[2]
        assert torch.equal(single.eigenfunctions[0], together.eigenfunctions[i, :, :width])
    other = collate(signatures).interior.subset(6, seed=4)
    assert not torch.equal(other.points, together.points)
    torch.manual_seed(0)
    first = collate(signatures).interior.subset(6)
    assert not torch.equal(collate(signatures).interior.subset(6).points, first.points)


def equal(one, other):
    """Whether two batches hold the same shapes, however they are padded."""
    if one.ids != other.ids or one.labels.tolist() != other.labels.tolist():
        return False
    return all(map(same_body, one.bodies(), other.bodies()))


def same_body(one, other):
    if (one.area, one.volume) != (other.area, other.volume):
        return False
    if not np.array_equal(one.eigenvalues, other.eigenvalues):
        return False
    return same_samples(one.interior, other.interior) and same_samples(one.surface, other.surface)


def same_samples(one, other):
    pairs = [(one.points, other.points), (one.eigenfunctions, other.eigenfunctions)]
    pairs += [(one.attributes[name], values) for name, values in other.attributes.items()]
    return all(np.array_equal(a, b) for a, b in pairs)


@pytest.mark.parametrize(
    ("index", "chosen"),
    [
        (slice(None, None, 2), [0, 2]),
        (slice(None, None, -1), [2, 1, 0]),
        ([2, 0], [2, 0]),
        (torch.tensor([1, 1]), [1, 1]),
        ([True, False, True], [0, 2]),
        (np.array([False, False, True]), [2]),
        (slice(0, 0), []),
    ],
)
def test_some_shapes_of_a_batch_are_the_batch_of_them(signatures, index, chosen):
    items = [
        LabelledSignature(signature, 4 - i, f"number {i}") for i, signature in enumerate(signatures)
    ]
    some = collate(items)[index]
    assert len(some) == len(chosen)
    assert not chosen or equal(some, collate([items[i] for i in chosen]))


def test_one_shape_of_a_batch_is_a_body(signatures):
    batch = collate(signatures)
    numbers = (0, -1, np.int64(1), torch.tensor(2), np.array(0))
    assert [batch[i].id for i in numbers] == ["body 0", "body 2", "body 1", "body 2", "body 0"]
    assert_array_equal(batch[2].eigenvalues, signatures[2].eigenvalues)
    assert [body.id for body in batch.bodies()] == list(batch.ids)
    with pytest.raises(IndexError):
        batch[3]
    with pytest.raises(IndexError, match="mask: expected 3 entries"):
        batch[[True, False]]


@pytest.mark.filterwarnings("ignore:Trying to infer the `batch_size`")
def test_lightning_finds_the_size_of_a_batch(signatures):
    """For `self.log` in a LightningModule of one's own."""
    from pytorch_lightning.utilities.data import extract_batch_size

    assert extract_batch_size(collate(signatures)) == len(signatures)


def test_batches_are_joined_and_cut_again(signatures):
    first = collate(signatures[:1])
    second = collate(signatures[1:])
    joined = SignatureBatch.concatenate([first, second])
    assert equal(joined, collate(signatures))
    assert torch.equal(joined.eigenvalues, collate(signatures).eigenvalues)
    assert torch.equal(joined.interior.mask, collate(signatures).interior.mask)
    assert equal(joined[:1], first)
    assert equal(joined[1:], second)


def test_batches_that_do_not_fit_are_not_joined(signatures):
    box = trimesh.creation.box()
    mesh = Mesh(np.asarray(box.vertices), np.asarray(box.faces))
    with_mesh = collate(signatures[:1], [mesh])
    without = collate(signatures[1:])
    assert SignatureBatch.concatenate([with_mesh, with_mesh]).meshes == (mesh, mesh)
    with pytest.raises(ValueError, match="batches: expected meshes in all batches or in none"):
        SignatureBatch.concatenate([with_mesh, without])
    with pytest.raises(ValueError, match="batches: expected at least one"):
        SignatureBatch.concatenate([])
    bare = replace(
        signatures[0],
        interior=replace(signatures[0].interior, attributes={}),
    )
    with pytest.raises(ValueError, match="attributes: all bodies must carry the same"):
        SignatureBatch.concatenate([collate([bare]), without])


class Several(Dataset[Signature]):
    """Signatures in a list, as a Dataset of one's own gives them."""

    def __init__(self, signatures):
        self.signatures = signatures

    def __len__(self):
        return len(self.signatures)

    def __getitem__(self, index):
        return self.signatures[index]


def test_a_batch_is_fixed(signatures):
    batch = collate(signatures)
    with pytest.raises(FrozenInstanceError):
        batch.area = batch.area.double()


def test_a_batch_is_saved_and_loaded_without_trust(signatures, tmp_path):
    torch.save(collate(signatures), tmp_path / "batch.pt")
    with torch.serialization.safe_globals([SampleBatch, SignatureBatch]):
        loaded = torch.load(tmp_path / "batch.pt", weights_only=True)
    assert equal(loaded, collate(signatures))


def thinned(items):
    """Views of a batch, and a tensor that lies elsewhere."""
    batch = collate(items)
    half = batch.interior.map(lambda values: values[:, ::2])
    return replace(batch, area=2 * batch.area, interior=half)


def numbered(items):
    batch = collate(items)
    return replace(batch, labels=torch.arange(len(batch)))


@pytest.mark.parametrize("make", [thinned, numbered])
def test_a_worker_hands_over_what_its_user_makes_of_a_batch(signatures, make):
    loader = DataLoader(Several(signatures), batch_size=2, num_workers=1, collate_fn=make)
    for batch, right in zip(
        loader,
        map(make, (signatures[:2], signatures[2:])),
        strict=True,
    ):
        assert equal(batch, right)
        assert batch.labels.tolist() == right.labels.tolist()
        assert batch.area.tolist() == right.area.tolist()
        assert torch.equal(batch.interior.eigenfunctions, right.interior.eigenfunctions)


def test_numbers_of_samples_take_another_type_and_all_others_stay(signatures):
    batch = collate(signatures)
    other = batch.to(torch.float16)
    for one, before in ((other.interior, batch.interior), (other.surface, batch.surface)):
        assert torch.equal(one.points, before.points.half())
        assert torch.equal(one.eigenfunctions, before.eigenfunctions.half())
        for values in one.attributes.values():
            assert values.dtype == torch.float16
        assert torch.equal(one.mask, before.mask)
    for name in ("eigenvalues", "area", "volume", "labels"):
        assert torch.equal(getattr(other, name), getattr(batch, name))
        assert getattr(other, name).dtype == getattr(batch, name).dtype


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_batches_go_to_a_device_and_bodies_come_back(signatures):
    (pinned,) = DataLoader(
        Several(signatures), batch_size=3, num_workers=1, collate_fn=collate, pin_memory=True
    )
    assert pinned.interior.points.is_pinned()
    batch = pinned.to("cuda", non_blocking=True)
    assert equal(
        batch[torch.tensor([2, 0], device="cuda")].to("cpu"),
        collate([signatures[2], signatures[0]]),
    )
    assert equal(
        SignatureBatch.concatenate([batch[:1], batch[1:]]).to("cpu"),
        collate(signatures),
    )
    assert batch.interior.attributes["depth"].is_cuda
    assert batch.labels.is_cuda
    for body, signature in zip(batch.bodies(), signatures, strict=True):
        assert_array_equal(body.interior.eigenfunctions, signature.interior.eigenfunctions)


def test_a_batch_tells_in_a_line_what_it_is_and_does_not_unpack_to_two_bodies():
    batch = two_bodies()
    assert repr(batch) == (
        "SignatureBatch(2 bodies: a, b; 12 eigenpairs, interior (2, 40), surface (2, 40) samples, 2 classes, cpu)"
    )
    with pytest.raises(TypeError, match="not iterable"):
        iter(batch)


def test_a_batch_is_a_container_of_tensors_for_pytorch():
    batch = two_bodies()
    doubled = torch.utils._pytree.tree_map(lambda tensor: tensor[1:], batch)
    assert isinstance(doubled, SignatureBatch)
    assert torch.equal(doubled.interior.points, batch.interior.points[1:])
    assert torch.equal(
        doubled.surface.attributes["depth"],
        batch.surface.attributes["depth"][1:],
    )
    assert doubled.ids == batch.ids
