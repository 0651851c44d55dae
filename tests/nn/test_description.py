from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from trimesh.creation import icosphere

import jobs
from igps.data.dataset import SignatureDataset
from igps.data.requirements import Requirements
from igps.mesh.errors import MeshError
from igps.nn.axes import InteriorDistance, Potential
from igps.nn.description import describe
from igps.nn.descriptor import BodyDescriptor, HistogramDescriptor
from igps.nn.embedding import SpectralEmbedding
from igps.nn.histograms.pairs import PairHistogram
from igps.signature.signature import SignatureConfig

CONFIG = SignatureConfig(n_eigenpairs=12, resolution=8, min_samples=0, n_surface_samples=20)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = tmp_path_factory.mktemp("described")
    for i in range(4):
        body = icosphere(subdivisions=2)
        body.vertices *= [1.0, 1.0 + 0.2 * i, 1.5]
        body.export(root / f"{i}.off")
    return SignatureDataset(sorted(root.glob("*.off")), CONFIG, root / "cache")


def describe_usable(dataset, descriptor, **options):
    """Descriptions, and what could not be described."""
    failures = []
    return describe(dataset, descriptor, failures=failures, **options), failures


def histogram(n_eigenpairs=12):
    axes = [Potential(2), InteriorDistance(8)]
    return HistogramDescriptor(PairHistogram(axes, SpectralEmbedding(n_eigenpairs=n_eigenpairs)))


class Area(BodyDescriptor):
    """The area as the mesh has it, and of one body none."""

    name = "area"
    requirements = Requirements(mesh=True)

    def __init__(self, refused="none", dies=False):
        super().__init__()
        self.refused = refused
        self.dies = dies

    def describe_body(self, body):
        if body.id.endswith(self.refused):
            if self.dies:
                jobs.die_at_zero(0)
            raise ValueError("it is not to my liking")
        return np.array([body.mesh.area, body.area], dtype=np.float32)


@pytest.mark.parametrize(
    ("batch_size", "n_workers"),
    [(3, 1), (1, 3)],
)
def test_describe_is_the_descriptor_of_each_batch(dataset, batch_size, n_workers):
    descriptor = histogram()
    expected = torch.cat([descriptor(dataset.batch([i])) for i in range(4)])
    threads = torch.get_num_threads()
    found = describe(dataset, descriptor, batch_size=batch_size, n_workers=n_workers)
    torch.testing.assert_close(found, expected, atol=1e-7, rtol=0)
    assert torch.get_num_threads() == threads
    usable, failures = describe_usable(dataset, descriptor, n_workers=n_workers)
    torch.testing.assert_close(usable, expected, atol=1e-7, rtol=0)
    assert failures == []


def test_meshes_come_to_descriptors_that_need_them(dataset):
    expected = [
        [
            dataset.mesh(i).area,
            dataset[i].signature.area,
        ]
        for i in range(4)
    ]
    assert_allclose(describe(dataset, Area(), n_workers=1), expected, rtol=1e-6)


def test_any_module_describes_in_evaluation_mode_and_keeps_its_modes(dataset):
    modes = []

    class Looking(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.frozen = torch.nn.Dropout().eval()
            self.trained = torch.nn.Dropout()

        def forward(self, batch):
            modes.extend(one.training for one in self.modules())
            assert not torch.is_grad_enabled()
            return self.trained(torch.ones(len(batch), 50))

    module = Looking()
    assert torch.equal(
        describe(dataset, module, batch_size=2, n_workers=2),
        torch.ones(4, 50),
    )
    assert modes == [False] * 6
    assert module.training is True
    assert module.frozen.training is False
    assert module.trained.training is True


@pytest.mark.parametrize("function", [describe, describe_usable])
def test_a_descriptor_that_needs_more_refuses(dataset, function):
    """Before anything is computed, and names what is missing."""
    with pytest.raises(
        ValueError, match="n_eigenpairs: this descriptor needs signatures of at least 13, got 12"
    ):
        function(dataset, histogram(13))
    cosines = HistogramDescriptor(PairHistogram(["pair_cosines"]))
    with pytest.raises(
        ValueError,
        match=r"attributes: this descriptor needs signatures with surface_direction, got ",
    ):
        function(dataset, cosines)


def test_what_cannot_be_described_is_listed(dataset):
    area = Area(refused="2.off")
    values, failures = describe_usable(dataset, area, n_workers=1)
    assert_allclose(
        values[:, 1],
        [dataset[i].signature.area for i in (0, 1, 3)],
        rtol=1e-6,
    )
    (failure,) = failures
    assert failure.path == dataset.bodies.paths[2]
    assert failure.error == f"{failure.path}: it is not to my liking"
    with pytest.raises(MeshError, match=re.escape(failure.error)):
        describe(dataset, area, n_workers=1)
    with pytest.raises(MeshError, match="it is not to my liking"):
        describe_usable(dataset, Area(refused=".off"), n_workers=1)


def test_a_mesh_that_cannot_be_read_is_listed(dataset, tmp_path):
    (tmp_path / "bad.off").write_text("nothing")
    paths = [dataset.bodies.paths[0], tmp_path / "bad.off"]
    both = SignatureDataset(paths, CONFIG, tmp_path / "cache")
    for batch_size in (1, 2):  # a bad mesh costs no other of its batch its description
        values, failures = describe_usable(both, histogram(), batch_size=batch_size, n_workers=1)
        assert values.shape == (1, 3, 8)
        assert [failure.path for failure in failures] == [tmp_path / "bad.off"]
    with pytest.raises(MeshError, match=r"bad\.off"):
        describe(both, histogram(), n_workers=1)


def test_a_body_that_kills_its_process_costs_no_other_its_description(dataset):
    values, failures = describe_usable(dataset, Area(refused="1.off", dies=True), n_workers=2)
    assert_allclose(
        values[:, 1],
        [dataset[i].signature.area for i in (0, 2, 3)],
        rtol=1e-6,
    )
    assert [failure.path for failure in failures] == [dataset.bodies.paths[1]]
    assert "was killed twice" in failures[0].error


def test_descriptions_that_are_not_finite_are_failures(dataset):
    class Broken(Area):
        def describe_body(self, body):
            return np.array(
                [np.nan if body.id.endswith("0.off") else 1.0],
                dtype=np.float32,
            )

    values, failures = describe_usable(dataset, Broken(), n_workers=1)
    assert values.shape == (3, 1)
    assert "0.off: the description has entries that are not finite" in failures[0].error


class Counting(HistogramDescriptor):
    """Remembers which bodies it was asked for."""

    def __init__(self):
        super().__init__(PairHistogram(["interior_distance"], SpectralEmbedding(n_eigenpairs=12)))
        self.asked: list[str] = []

    def describe(self, batch):
        self.asked += [body.id for body in batch.bodies()]
        return super().describe(batch)


def asked(dataset, cache_tag="one"):
    descriptor = Counting()
    values, failures = describe_usable(dataset, descriptor, cache_tag=cache_tag, n_workers=1)
    assert failures == []
    return [Path(name).stem for name in descriptor.asked], values


@pytest.fixture
def fresh(tmp_path):
    for i in range(3):
        body = icosphere(subdivisions=2)
        body.vertices *= [1.0, 1.0 + 0.2 * i, 1.5]
        body.export(tmp_path / f"{i}.off")
    paths = sorted(tmp_path.glob("*.off"))
    first = SignatureDataset(paths, CONFIG, tmp_path / "cache")
    assert first.precompute(n_workers=1, progress=False) == []
    return SignatureDataset(paths, CONFIG, tmp_path / "cache")  # which looks at the files again


def test_what_has_been_described_is_not_described_again(fresh):
    names, values = asked(fresh)
    assert names == ["0", "1", "2"]
    again, same = asked(fresh)
    assert again == []
    assert torch.equal(same, values)
    # Of a part, in another order, and beside what is new.
    assert asked(fresh.subset([2, 0]))[0] == []
    assert torch.equal(
        asked(fresh.subset([2, 0]))[1],
        values[[2, 0]],
    )


def test_descriptions_are_kept_by_all_that_they_depend_on(fresh):
    paths = fresh.bodies.paths
    _, values = asked(fresh)
    assert asked(fresh, cache_tag="other words")[0] == ["0", "1", "2"]
    assert asked(fresh, cache_tag=None)[0] == ["0", "1", "2"]
    more = SignatureDataset(paths, replace(CONFIG, seed=1), fresh.pipeline.cache_dir)
    more.precompute(n_workers=1, progress=False)
    assert asked(more)[0] == ["0", "1", "2"]
    with_own = SignatureDataset(
        paths, CONFIG, fresh.pipeline.cache_dir, attributes={"height": lambda body, x: x[:, 2]}
    )
    assert asked(with_own)[0] == asked(with_own)[0] == ["0", "1", "2"]
    body = icosphere(subdivisions=2)
    body.vertices *= [2.0, 0.7, 0.5]
    body.export(paths[1])
    names, other = asked(fresh)
    assert names == ["1"]
    assert torch.equal(other[[0, 2]], values[[0, 2]])
    assert not torch.equal(other[1], values[1])


def test_a_file_that_changes_meanwhile_is_not_mistaken_for_what_it_was(fresh):
    """Two files change places while they are described: neither description is kept as that of the other."""
    first, second = fresh.bodies.paths[:2]
    _, values = asked(fresh, cache_tag=None)

    class Meddling(Counting):
        def describe(self, batch):
            if not self.asked:
                other = first.with_suffix(".other")
                first.rename(other)
                second.rename(first)
                other.rename(second)
            return super().describe(batch)

    describe_usable(fresh, Meddling(), cache_tag="one", n_workers=1)
    assert torch.equal(asked(fresh)[1], values[[1, 0, 2]])


def test_damaged_descriptions_are_made_again(fresh, caplog):
    _, values = asked(fresh)
    first, second, _ = sorted((fresh.pipeline.cache_dir / "descriptions").rglob("*.safetensors"))
    content = bytearray(first.read_bytes())
    content[-1] ^= 1
    first.write_bytes(content)
    second.write_bytes(second.read_bytes()[:-8])
    names, again = asked(fresh)
    assert len(names) == 2
    assert torch.equal(again, values)
    assert caplog.text.count("cached description is not usable") == 2
    assert asked(fresh)[0] == []


def test_where_descriptions_cannot_be_kept_they_are_made(fresh, caplog):
    (fresh.pipeline.cache_dir / "descriptions").write_text("in the way")
    for _ in range(2):
        assert asked(fresh)[0] == ["0", "1", "2"]
    assert caplog.text.count("descriptions are not cached") == 2


def test_failures_are_not_kept(fresh):
    for refused in ("1.off", "2.off"):
        values, failures = describe_usable(
            fresh, Area(refused=refused), cache_tag="area", n_workers=1
        )
        assert len(values) + len(failures) == 3
        # What was refused at first is described the second time, and what is kept is not refused any more.
        names = [Path(failure.id).name for failure in failures]
        assert names == (["1.off"] if refused == "1.off" else [])
