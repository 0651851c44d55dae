"""The example of the page *Add a descriptor*, as another package would install it."""

import pytest

import igps
from igps.signature.signature import SignatureConfig
from page_packages import files_of_page, install_page

PAGE = "add-descriptor.md"


@pytest.fixture
def installed(on_path):
    """The package of the page, laid out on the Python path as pip would do it."""
    install_page(PAGE, on_path)


def test_the_example_is_short():
    text = "".join(files_of_page(PAGE).values())
    assert len(text.splitlines()) <= 30


def test_an_installed_descriptor_is_known_by_its_name(installed, blob):
    config = SignatureConfig(n_eigenpairs=5, resolution=6, min_samples=0, n_surface_samples=50)
    batch = igps.collate([igps.compute_signature(blob, config)])
    roundness = igps.descriptor("roundness")
    assert not roundness.training
    assert roundness(batch).item() == pytest.approx(blob.volume / blob.area**1.5)


def test_a_wrong_name_lists_installed_descriptors_too(installed):
    with pytest.raises(ValueError, match=r"expected one of interior, .*, roundness, or package"):
        igps.descriptor("round")


def test_a_name_of_the_library_stays_its_own(on_path):
    info = on_path / "other-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[igps.descriptors]\nd2 = math:pi\n")
    assert igps.descriptor("d2").name == "d2"
