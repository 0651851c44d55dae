import pickle
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from torch.utils.data import DataLoader

import igps
import igps.data.pipeline as pipeline_module
from bodies_on_disk import write_body
from igps.analysis.explanation import explain
from igps.data.batch import LabelledSignature, SignatureBatch
from igps.data.collation import collate
from igps.data.dataset import Failure, SignatureDataset
from igps.data.transforms import FewerSamples
from igps.failures import Limits, MachineError
from igps.mesh.errors import MeshError
from igps.nn.descriptor import HistogramDescriptor
from igps.nn.histograms import PairHistogram
from igps.signature.signature import SignatureConfig
from own_descriptors import small_interior

CONFIG = SignatureConfig(n_eigenpairs=20, resolution=10, min_samples=0, n_surface_samples=50)


@pytest.fixture
def root(tmp_path):
    """Two classes of two small bodies each."""
    for label, ratio in (("ball", 1.0), ("egg", 1.7)):
        for i in (1, 2):
            write_body(tmp_path / "meshes" / label / f"{i}.off", 1.0 + 0.05 * i, ratio)
    return tmp_path / "meshes"


@pytest.fixture
def dataset(root, tmp_path):
    return SignatureDataset(root, CONFIG, tmp_path / "cache")


@pytest.fixture
def counted(monkeypatch):
    """Names of the meshes whose signature is computed, not read."""
    names = []
    compute = pipeline_module.compute_signature

    def counting(mesh, config):
        names.append(mesh.name)
        return compute(mesh, config)

    monkeypatch.setattr(pipeline_module, "compute_signature", counting)
    return names


def test_a_batch_takes_only_the_samples_that_its_descriptor_reads(dataset, root, tmp_path):
    inside = small_interior()
    on_surface = HistogramDescriptor(PairHistogram(samples="surface"))
    own = SignatureDataset(root, CONFIG, tmp_path / "cache", descriptor=inside)
    for n_workers in (0, 1):
        loader = DataLoader(own, batch_size=4, collate_fn=collate, num_workers=n_workers)
        (batch,) = loader
        assert batch.surface.points.shape == (4, 0, 3)
        assert torch.equal(inside(batch), inside(dataset.batch(range(4))))
    assert len(own[0].signature.surface) == 50
    with pytest.raises(ValueError, match="batch: expected surface samples, got none"):
        on_surface(batch)
    assert torch.equal(igps.describe(own, on_surface), igps.describe(dataset, on_surface))
    with pytest.raises(ValueError, match="batch: expected surface samples, got none"):
        explain(inside, own.batch([0]), own.batch([1]))


def test_items_are_labelled_and_named(dataset):
    item = dataset[2]
    assert isinstance(item, LabelledSignature)
    assert item.id == "egg/1.off"
    assert item.label == 1
    assert item.signature.name == "egg/1.off"
    assert dataset.classes == ("ball", "egg")
    assert dataset.labels.tolist() == [0, 0, 1, 1]
    assert item.signature.config == CONFIG


def test_functions_of_position_become_attributes(root, tmp_path):
    dataset = SignatureDataset(
        root, CONFIG, tmp_path / "cache", attributes={"height": lambda body, points: points[:, 2]}
    )
    for part in (dataset, dataset.subset([0, 3])):
        for samples in (part[1].signature.interior, part[1].signature.surface):
            height = samples.attributes["height"]
            assert_allclose(height, samples.points[:, 2], rtol=1e-6)
    assert SignatureDataset(root, CONFIG, tmp_path / "cache")[0].signature.interior.attributes == {}
    wrong = {"height": lambda body, points: points[:-1]}
    broken = SignatureDataset(root, CONFIG, tmp_path / "cache", attributes=wrong)
    with pytest.raises(
        ValueError, match=r"ball/1.off: attributes: height: expected a finite number"
    ):
        broken[0]


def test_the_name_of_an_attribute_is_no_source(root, tmp_path):
    with pytest.raises(
        ValueError,
        match=r"attributes: expected functions or sources by names other than .*, got h='depth'",
    ):
        SignatureDataset(root, CONFIG, tmp_path / "cache", attributes={"h": "depth"})


def test_an_attribute_does_not_stand_in_for_one_of_the_library(root, tmp_path):
    with pytest.raises(
        ValueError,
        match=r"names other than .*depth.*, got depth=.*of the library are set by SignatureConfig",
    ):
        SignatureDataset(
            root,
            CONFIG,
            tmp_path / "cache",
            attributes={"depth": lambda body, points: points[:, 2]},
        )


def test_key_covers_every_parameter(root, tmp_path):
    changes = {
        "n_eigenpairs": 21,
        "resolution": 11,
        "min_samples": 300,
        "n_surface_samples": 51,
        "backend": "robust",
        "max_vertices": 100,
        "accuracy": None,
        "attributes": ("depth",),
        "seed": 1,
        "least_vertices": 200,
    }
    assert {field.name for field in fields(CONFIG)} == {*changes, "measures"}
    configs = [
        CONFIG,
        *(replace(CONFIG, **{name: new}) for name, new in changes.items()),
    ]
    keys = {SignatureDataset(root, config, tmp_path / "cache").key(0) for config in configs}
    assert len(keys) == 1 + len(changes)
    measured = SignatureDataset(root, replace(CONFIG, measures=True), tmp_path / "cache")
    assert measured.key(0) in keys  # plain numbers have a record of their own


def test_key_covers_content_and_version_but_not_the_path(root, tmp_path, counted, monkeypatch):
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    dataset[0]
    (root / "ball" / "1.off").rename(root / "egg" / "9.off")
    moved = SignatureDataset(root, CONFIG, tmp_path / "cache")
    assert moved[3].id == moved[3].signature.name == "egg/9.off"
    assert len(counted) == 1
    (root / "egg" / "9.off").write_text((root / "egg" / "1.off").read_text())
    moved[3]
    assert len(counted) == 2
    monkeypatch.setattr(SignatureConfig, "ALGORITHM_VERSION", SignatureConfig.ALGORITHM_VERSION + 1)
    moved[3]
    assert len(counted) == 3


@pytest.mark.parametrize("cache", ["file", "file/cache"])
def test_a_cache_that_cannot_be_made_is_no_fault_of_the_bodies(root, tmp_path, cache):
    (tmp_path / "file").touch()
    with pytest.raises(
        MachineError,
        match=rf"cache_dir: {tmp_path / cache} cannot be created .*Choose a writable folder",
    ):
        SignatureDataset(root, CONFIG, tmp_path / cache).precompute(n_workers=1)


@pytest.mark.parametrize("how", ["processes", "threads"])
def test_precompute_fills_the_cache_and_lists_bad_meshes(root, tmp_path, how):
    (root / "egg" / "bad.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    dataset = SignatureDataset(root, CONFIG, tmp_path / "cache")
    if how == "threads":
        with ThreadPoolExecutor(2) as pool:
            failures = dataset.precompute(pool, progress=False)
    else:
        failures = dataset.precompute(n_workers=2, progress=False)
    (failure,) = failures
    assert failure.id == "egg/bad.off"
    assert "a single triangle" in failure.error
    assert len(list((tmp_path / "cache" / "signatures").rglob("*.safetensors"))) == 4
    usable = dataset.usable(failures)
    assert usable.bodies.names == ("ball/1.off", "ball/2.off", "egg/1.off", "egg/2.off")
    assert usable.labels.tolist() == [0, 0, 1, 1]


def test_precompute_resumes(dataset, counted):
    dataset[1]
    assert dataset.precompute(n_workers=1, progress=False) == []
    assert len(counted) == 4
    assert dataset.precompute(n_workers=1, progress=False) == []
    assert len(counted) == 4


def test_a_missing_file_is_a_failure_like_any_other(root, tmp_path):
    dataset = SignatureDataset(
        [root / "ball" / "1.off", root / "gone.off"], CONFIG, tmp_path / "cache"
    )
    (failure,) = dataset.precompute(n_workers=1, progress=False)
    assert "gone.off" in failure.error
    with pytest.raises(MeshError, match=r"gone\.off"):
        dataset[1]


def test_batch_has_the_meshes_on_demand(dataset):
    assert dataset.batch([3, 1]).meshes is None
    batch = dataset.batch([3, 1], meshes=True)
    assert isinstance(batch, SignatureBatch)
    assert batch.ids == ("egg/2.off", "ball/2.off")
    assert batch.labels.tolist() == [1, 0]
    for mesh, body, i in zip(
        batch.meshes or (),
        batch.bodies(),
        (3, 1),
        strict=True,
    ):
        assert_array_equal(mesh.vertices, dataset.mesh(i).vertices)
        assert mesh.area == pytest.approx(body.area)


class Named(SignatureDataset):
    """With something of its own."""

    motto = "mine"


def test_parts_of_a_subclass_are_of_it_and_keep_what_it_has(root, tmp_path):
    dataset = Named(root, CONFIG, tmp_path / "cache")
    dataset.motto = "changed"
    failure = Failure("ball/1.off", root / "ball" / "1.off", "bad")
    parts = (dataset.subset([1, 2]), dataset.usable([failure]), dataset[1:3], dataset.to_memory())
    for part in parts:
        assert isinstance(part, Named)
        assert part.motto == "changed"
    parts[0].motto = "another"
    assert dataset.motto == "changed"


@pytest.mark.parametrize(
    ("index", "chosen"),
    [
        (slice(1, 3), [1, 2]),
        (slice(None, None, -1), [3, 2, 1, 0]),
        ([3, 0], [3, 0]),
        (["egg/1.off", "ball/2.off"], [2, 1]),
        ([False, True, False, True], [1, 3]),
        (torch.tensor([True, False, False, False]), [0]),
        (np.array([2, -1]), [2, 3]),
        ([], []),
    ],
)
def test_some_items_are_a_dataset(dataset, index, chosen):
    part = dataset[index]
    assert part.bodies.names == tuple(dataset.bodies.names[i] for i in chosen)
    assert part.labels.tolist() == dataset.labels[chosen].tolist()


def test_an_item_is_asked_for_by_number_or_name(dataset):
    assert dataset[-1].id == "egg/2.off"
    assert dataset[np.int64(2)].id == "egg/1.off"
    assert dataset["ball/2.off"].id == "ball/2.off"
    assert [item.id for item in dataset] == list(dataset.bodies.names)
    for number in (torch.tensor(2), np.array(2)):
        assert dataset[number].id == "egg/1.off"
    with pytest.raises(IndexError):
        dataset[4]
    with pytest.raises(IndexError, match="mask: expected 4 entries, got an array of shape"):
        dataset[[True]]
    first = dataset.bodies.names[0]
    with pytest.raises(KeyError, match=f"no body is called 'cat'; the first is called '{first}'"):
        dataset["cat"]


def test_the_descriptor_says_what_signatures_it_is_for(root, tmp_path):
    """Itself, or what it requires, as its requirements applied by hand."""
    rich = igps.descriptor("rich")
    expected = rich.requirements.apply_to(SignatureConfig()).resolved()
    for descriptor in (rich, rich.requirements):
        assert SignatureDataset(root, descriptor=descriptor).config == expected
    small = SignatureConfig(n_eigenpairs=20)
    usual = replace(CONFIG, n_eigenpairs=None)
    dataset = SignatureDataset(root, usual, descriptor=igps.descriptor("shape_dna"))
    assert dataset.config.resolution == 10
    with pytest.raises(ValueError, match="n_eigenpairs: this descriptor needs"):
        SignatureDataset(root, small, descriptor=rich)
    with pytest.raises(TypeError, match=r"got its name. Give igps.descriptor\('rich'\)"):
        SignatureDataset(root, descriptor="rich")


def test_after_precompute_the_meshes_are_not_needed(dataset, root, counted):
    before = [dataset[i].signature for i in range(4)]
    assert dataset.precompute(n_workers=1, progress=False) == []
    keys = dataset.cached_keys()
    notes = dataset.all_notes()
    counted.clear()
    shutil.rmtree(root)
    for part in (dataset, pickle.loads(pickle.dumps(dataset)), dataset.subset(range(4))):
        for item, expected in zip(part, before, strict=True):
            functions = item.signature.interior.eigenfunctions
            assert_array_equal(functions, expected.interior.eigenfunctions)
        assert part.cached_keys() == keys
        assert part.all_notes() == notes
    assert counted == []
    with pytest.raises(MeshError, match=r"1\.off"):
        dataset.mesh(0)


def test_in_memory_nothing_is_read_any_more(dataset, root, tmp_path):
    before = collate([dataset[i] for i in range(4)])
    kept = dataset.to_memory()
    shutil.rmtree(root)
    shutil.rmtree(tmp_path / "cache")
    assert torch.equal(
        kept.batch(range(4)).interior.eigenfunctions,
        before.interior.eigenfunctions,
    )
    assert torch.equal(
        kept[[3, 1]].batch([0, 1]).labels,
        before.labels[[3, 1]],
    )
    assert kept.subset([2])[0].id == "egg/1.off"
    assert len(pickle.dumps(kept.subset([2]))) < len(pickle.dumps(kept)) / 2
    assert kept.precompute() == []


def test_a_transform_is_applied_at_each_reading_and_not_kept(dataset, counted):
    plain = dataset[0].signature
    changed = SignatureDataset(
        dataset.bodies,
        CONFIG,
        dataset.pipeline.cache_dir,
        transform=FewerSamples(n_interior=5, n_surface=5),
    )
    torch.manual_seed(0)
    first = changed[0].signature
    second = changed[0].signature
    assert len(first.interior) == len(second.surface) == 5
    assert not np.array_equal(first.interior.points, second.interior.points)
    assert len(counted) == 1
    assert changed.cached_keys() == [None] * 4
    assert len(changed.to_memory()._signature(0).interior) == len(plain.interior)
    assert len(changed.subset([0])[0].signature.interior) == 5


class CountedTransform:
    """A transform of one's own, which counts its bodies."""

    def __init__(self, seed, applied):
        self.few = FewerSamples(n_interior=9, seed=seed)
        self.applied = applied

    @property
    def cache_tag(self):
        return self.few.cache_tag

    def __call__(self, signature):
        self.applied.append(signature.name)
        return self.few(signature)


def test_a_pre_transform_is_kept_under_a_key_of_its_own(dataset, counted, root):
    dataset.precompute(n_workers=1, progress=False)
    counted.clear()
    applied = []

    def changed(seed):
        own = CountedTransform(seed, applied)
        return SignatureDataset(root, CONFIG, dataset.pipeline.cache_dir, pre_transform=own)

    first = changed(0)
    points = first[0].signature.interior.points
    assert len(points) == 9
    assert (points == changed(0)[0].signature.interior.points).all()
    assert len(applied) == 1
    assert (points != changed(1)[0].signature.interior.points).any()
    assert len(applied) == 2
    assert counted == []  # no eigenpairs for any of it
    assert first.precompute(n_workers=1, progress=False) == []
    assert len(applied) == 5
    keys = first.cached_keys()
    # Of the last one is, and None
    found = len(
        {
            *keys,
            *dataset.cached_keys(),
            *changed(1).cached_keys(),
        }
    )
    assert found == 10
    assert changed(0).cached_keys() == keys
    assert [first.key(i) for i in range(len(first))] == keys
    for wrong, message in (
        (FewerSamples(n_interior=9), "expected a seed"),
        (lambda signature: signature, "expected an object with a cache_tag"),
    ):
        with pytest.raises(ValueError, match=f"pre_transform: {message}"):
            SignatureDataset(root, CONFIG, dataset.pipeline.cache_dir, pre_transform=wrong)


class Image:
    """A linear function of space, as an image on a grid would be, with a checksum and a count of its readings."""

    def __init__(self, slope, n_channels=None):
        self.slope = slope
        self.n_channels = n_channels
        self.read = 0

    def cache_tag(self, body):
        return f"{body.path.parent.name} {self.slope} {self.n_channels}"

    def __call__(self, body, points):
        self.read += 1
        values = self.slope * points[:, 2] + 100 * (body.path.parent.name == "egg")
        return (
            values
            if self.n_channels is None
            else np.stack(
                [values] * self.n_channels,
                axis=1,
            )
        )


def test_an_attribute_is_added_to_cached_signatures_without_new_eigenpairs(
    dataset, counted, root, tmp_path
):
    dataset.precompute(n_workers=1, progress=False)
    counted.clear()
    image = Image(2.0)

    def with_image(source):
        return SignatureDataset(root, CONFIG, tmp_path / "cache", attributes={"ct": source})

    for again in range(2):
        one = with_image(image)
        assert one.precompute(n_workers=1, progress=False) == []
        assert image.read == 4  # of each body once
        for i, item in enumerate(one):
            for samples in (item.signature.interior, item.signature.surface):
                expected = 2 * samples.points[:, 2] + (100 if i > 1 else 0)
                assert_allclose(samples.attributes["ct"], expected, rtol=1e-6)
        assert again or one.cached_keys() != dataset.cached_keys()
    assert counted == []
    # Another image, and several channels, are other values; what was there stays.
    other = with_image(Image(3.0))[0].signature.interior
    assert other.attributes["ct"][0] != one[0].signature.interior.attributes["ct"][0]
    many = with_image(Image(2.0, 4))
    assert many.batch([0, 3]).interior.attributes["ct"].shape[2] == 4
    assert dataset[0].signature.interior.attributes == {}
    assert counted == []
    shutil.rmtree(root)
    assert one[3].signature.interior.attributes["ct"].max() > 90


def test_a_pre_transform_changes_a_copy_of_a_file_alike_whichever_comes_first(tmp_path):
    for name in ("a", "b"):
        write_body(tmp_path / f"{name}.off", 1.1, 1.3)
    files = [tmp_path / "a.off", tmp_path / "b.off"]
    found = []
    for number, order in enumerate((files, files[::-1])):
        dataset = SignatureDataset(
            order,
            CONFIG,
            tmp_path / f"cache {number}",
            pre_transform=FewerSamples(n_interior=6, seed=0),
        )
        found += [dataset[0].signature, dataset[1].signature]
    assert [Path(one.name).name for one in found] == ["a.off", "b.off", "b.off", "a.off"]
    for one in found[1:]:
        assert_array_equal(one.interior.points, found[0].interior.points)


def test_a_pre_transform_is_given_the_attributes_and_depends_on_them(root, tmp_path):
    def changed(slope):
        return SignatureDataset(
            root,
            CONFIG,
            tmp_path / "cache",
            attributes={"ct": Image(slope)},
            pre_transform=FewerSamples(n_interior=6, seed=0),
        )

    for slope in (2.0, 3.0, 2.0):
        dataset = changed(slope)
        dataset.precompute(n_workers=1, progress=False)
        samples = dataset[1].signature.interior
        assert len(samples) == 6
        assert_allclose(samples.attributes["ct"], slope * samples.points[:, 2], rtol=1e-6)
    assert changed(2.0).cached_keys() != changed(3.0).cached_keys()
    with pytest.raises(ValueError, match="pre_transform: expected attributes with a cache_tag"):
        SignatureDataset(
            root,
            attributes={"x": lambda body, points: points[:, 0]},
            pre_transform=FewerSamples(seed=0),
        )


@pytest.mark.parametrize(("start", "how"), [("fork", "cache"), ("spawn", "memory")])
def test_workers_give_what_this_process_gives(dataset, root, tmp_path, how, start):
    dataset.precompute(n_workers=1, progress=False)
    expected = dataset.batch(range(4))
    if how == "memory":
        dataset = dataset.to_memory()
    shutil.rmtree(root)
    loader = DataLoader(
        dataset,
        batch_size=2,
        num_workers=2,
        persistent_workers=True,
        collate_fn=collate,
        multiprocessing_context=start,
    )
    for _ in range(2):
        found = SignatureBatch.concatenate(list(loader))
        assert found.ids == expected.ids
        assert torch.equal(found.interior.eigenfunctions, expected.interior.eigenfunctions)
        assert torch.equal(found.labels, expected.labels)


def test_slow_meshes_are_listed(dataset, tmp_path):
    (failure,) = dataset.subset([2]).precompute(
        n_workers=1, progress=False, limits=Limits(seconds=1e-6)
    )
    assert failure.id == "egg/1.off"
    assert failure.error.startswith(f"{failure.path}: it took longer than the time_limit")
    assert not list((tmp_path / "cache").rglob("*.safetensors"))


def test_a_dataset_has_the_names_of_torchvision_and_tells_in_a_line_what_it_is(tmp_path):
    for name in ("balls/1.off", "balls/2.off", "rods/1.off"):
        write_body(tmp_path / name, 1.0, 2.0)
    dataset = SignatureDataset(tmp_path, SignatureConfig(n_eigenpairs=9))
    assert dataset.targets == [0, 0, 1]
    assert dataset.class_to_idx == {"balls": 0, "rods": 1}
    assert repr(dataset) == "SignatureDataset(3 bodies, 2 classes: balls, rods; 9 eigenpairs)"


def test_a_disk_that_is_full_costs_only_the_cache(tmp_path, monkeypatch, caplog):
    write_body(tmp_path / "1.off", 1.0, 2.0)
    config = SignatureConfig(n_eigenpairs=9, resolution=8, min_samples=0, n_surface_samples=20)
    dataset = SignatureDataset(tmp_path, config, tmp_path / "cache")

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("igps.data.cache.Cache.put", full)
    assert dataset[0].signature.eigenvalues.shape == (9,)
    assert "a signature is not stored" in caplog.text
