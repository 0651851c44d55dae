"""The same labels in every format give the same bodies; what is no label volume is refused in a sentence."""

import gzip
import json
import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from igps.fields.volumes.label_names import read_label_names
from igps.fields.volumes.label_volume import (
    LabelVolume,
    label_surface,
    read_label_volume,
    volume_in_memory,
)
from igps.mesh.errors import MeshError
from igps.mesh.formats import dependencies_of
from igps.mesh.loading import each_body, list_bodies, load_mesh
from igps.mesh.options import LoadOptions
from label_files import write_nifti

nibabel = pytest.importorskip("nibabel", reason="the extra [volumes]")
sitk = pytest.importorskip("SimpleITK", reason="the extra [volumes]")
tifffile = pytest.importorskip("tifffile", reason="the extra [volumes]")

# Left-handed, turned about z, with voxels of 1 × 1.5 × 2.5 mm.
TURN = np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]])
AFFINE = np.eye(4)
AFFINE[:3, :3] = TURN @ np.diag([-1, 1.5, 2.5])
AFFINE[:3, 3] = (30, -20, 10)


def two_boxes():
    labels = np.zeros((14, 12, 10), dtype=np.uint8)
    labels[1:7, 2:10, 1:9] = 3
    labels[7:12, 2:10, 1:9] = 7
    return labels


def itk_image(labels, affine=AFFINE, vector=False):
    image = sitk.GetImageFromArray(
        np.ascontiguousarray(np.swapaxes(labels, 0, 2)),
        isVector=vector,
    )
    lps = np.diag([-1, -1, 1, 1]) @ affine
    spacing = norm(lps[:3, :3], axis=0)
    image.SetSpacing(spacing.tolist())
    image.SetDirection((lps[:3, :3] / spacing).ravel().tolist())
    image.SetOrigin(lps[:3, 3].tolist())
    return image


def write_nibabel(path, labels):
    kind = nibabel.MGHImage if path.suffix in (".mgh", ".mgz") else nibabel.Nifti1Image
    nibabel.save(kind(labels, AFFINE), path)


def write_itk(path, labels):
    sitk.WriteImage(itk_image(labels), str(path), useCompression=True)


def write_dicom(path, labels):
    write_segmentation(path, masks_of(labels), ["left part", "right part"], "BINARY")


def masks_of(labels):
    return np.stack([labels == value for value in np.unique(labels)[1:]], axis=-1).astype(np.uint8)


def write_segmentation(path, masks, names, *kind):
    """Planes of a scanner whose axes are those of the affine, as highdicom writes them."""
    pytest.importorskip("highdicom", reason="the extra [volumes]")
    from highdicom.seg import Segmentation, SegmentDescription
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.sr.codedict import codes
    from pydicom.uid import ExplicitVRLittleEndian, generate_uid

    lps = np.diag([-1, -1, 1, 1]) @ AFFINE
    spacing = norm(lps[:3, :3], axis=0)
    planes = []
    study = generate_uid()
    series = generate_uid()
    frame = generate_uid()
    for k in range(masks.shape[2]):
        plane = Dataset()
        plane.file_meta = FileMetaDataset()
        plane.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
        plane.SOPClassUID = "1.2.840.10008.5.1.4.1.1.2"
        plane.SOPInstanceUID = generate_uid()
        plane.StudyInstanceUID = study
        plane.SeriesInstanceUID = series
        plane.FrameOfReferenceUID = frame
        plane.PatientID = "1"
        plane.PatientName = "A^B"
        plane.PatientBirthDate = ""
        plane.PatientSex = ""
        plane.StudyDate = "20200101"
        plane.StudyTime = "000000"
        plane.StudyID = "1"
        plane.AccessionNumber = ""
        plane.ReferringPhysicianName = ""
        plane.SeriesNumber = 1
        plane.InstanceNumber = k + 1
        plane.Modality = "CT"
        plane.Rows = masks.shape[1]
        plane.Columns = masks.shape[0]
        plane.PixelSpacing = [spacing[1], spacing[0]]
        plane.SliceThickness = spacing[2]
        plane.ImageOrientationPatient = [
            *(lps[:3, 0] / spacing[0]),
            *(lps[:3, 1] / spacing[1]),
        ]
        plane.ImagePositionPatient = list(lps[:3, 3] + k * lps[:3, 2])
        plane.BitsAllocated = plane.BitsStored = 16
        plane.SamplesPerPixel = 1
        plane.PhotometricInterpretation = "MONOCHROME2"
        plane.PixelRepresentation = 0
        planes.append(plane)
    described = [
        SegmentDescription(number, name, codes.SCT.Organ, codes.SCT.Organ, "MANUAL")
        for number, name in enumerate(names, start=1)
    ]
    method, *fractions = kind
    how = dict(zip(("fractional_type", "max_fractional_value"), fractions, strict=False))
    frames = masks.transpose(2, 1, 0, 3)
    series = (generate_uid(), 1, generate_uid(), 1)
    maker = ("maker", "model", "1", "1")
    Segmentation(planes, frames, method, described, *series, *maker, **how).save_as(path)


def label_bodies(volume):
    return [(body.label, body.name, body.n_voxels) for body in volume.bodies]


WRITERS = {
    "x.nii": write_nibabel,
    "x.nii.gz": write_nibabel,
    "x.mgz": write_nibabel,
    "x.nrrd": write_itk,
    "x.mha": write_itk,
    "x.mhd": write_itk,
    "x.dcm": write_dicom,
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_gives_the_same_bodies_in_the_world(name, tmp_path):
    path = tmp_path / name
    WRITERS[name](path, two_boxes())
    volume = read_label_volume(path)
    assert volume.unit == "mm"
    bodies = label_bodies(volume)
    assert [n_voxels for _, _, n_voxels in bodies] == [384, 320]
    given = LabelVolume((two_boxes(),), AFFINE)
    for (label, _, n_voxels), at in zip(bodies, (3, 7), strict=True):
        mesh = label_surface(volume, label)
        expected = label_surface(given, at)
        found = sorted(mesh.vertices[:, 0])
        assert_allclose(found, sorted(expected.vertices[:, 0]), atol=1e-3)
        assert mesh.volume == pytest.approx(n_voxels * 1 * 1.5 * 2.5, rel=1e-3)
        centre = AFFINE[:3, :3] @ np.argwhere(two_boxes() == at).mean(axis=0) + AFFINE[:3, 3]
        assert_allclose(mesh.vertices.mean(axis=0), centre, atol=0.4)


def test_a_stack_of_pictures_has_the_spacing_of_imagej_or_none(tmp_path):
    stack = np.ascontiguousarray(two_boxes().T)
    metadata = {"spacing": 2.0, "unit": "um", "axes": "ZYX"}
    path = tmp_path / "x.tif"
    tifffile.imwrite(
        path,
        stack,
        imagej=True,
        resolution=(2, 4),
        metadata=metadata,
    )
    volume = read_label_volume(tmp_path / "x.tif")
    assert_allclose(np.diag(volume.affine), [0.5e-3, 0.25e-3, 2e-3, 1])
    assert volume.unit == "mm"
    assert_array_equal(volume.layers[0], two_boxes())
    tifffile.imwrite(tmp_path / "y.tiff", stack, photometric="minisblack")
    plain = read_label_volume(tmp_path / "y.tiff")
    assert plain.unit is None
    assert label_surface(plain, 3).volume == pytest.approx(384, rel=1e-3)


@pytest.mark.parametrize(
    ("words", "sides", "unit"),
    [
        ("unit=\\u00B5m\nspacing=2.0\n", (0.5e-3, 0.25e-3, 2e-3), "mm"),
        ("unit=micron\n", (0.5e-3, 0.25e-3, 1e-3), "mm"),
        ("unit=pixel\nspacing=2.0\n", (0.5, 0.25, 2), None),
        ("", (0.5, 0.25, 1), None),
    ],
)
def test_imagej_escapes_units_and_leaves_a_spacing_of_one_out(words, sides, unit, tmp_path):
    stack = np.ascontiguousarray(two_boxes().T)
    about = f"ImageJ=1.53t\nimages={len(stack)}\nslices={len(stack)}\n{words}loop=false\n"
    how = {"photometric": "minisblack", "description": about, "metadata": None}
    tifffile.imwrite(tmp_path / "x.tif", stack, resolution=(2, 4), **how)
    volume = read_label_volume(tmp_path / "x.tif")
    assert_allclose(np.diag(volume.affine)[:3], sides)
    assert volume.unit == unit
    assert_array_equal(volume.layers[0], two_boxes())


def test_pages_that_were_written_one_by_one_are_a_stack(tmp_path):
    with tifffile.TiffWriter(tmp_path / "x.tif") as file:
        for page in np.ascontiguousarray(two_boxes().T):
            file.write(page, photometric="minisblack")
    assert_array_equal(read_label_volume(tmp_path / "x.tif").layers[0], two_boxes())


def test_a_stack_compressed_by_lzw_is_read(tmp_path):
    image = sitk.GetImageFromArray(np.ascontiguousarray(two_boxes().T))
    sitk.WriteImage(image, str(tmp_path / "x.tif"), useCompression=True, compressor="LZW")
    assert_array_equal(read_label_volume(tmp_path / "x.tif").layers[0], two_boxes())


def write_nrrd(path, *lines):
    """Boxes in voxels of 1 × 1.5 × 2.5, by hand."""
    sizes = ["sizes: 14 12 10", "encoding: raw"]
    spacing = ["spacings: 1 1.5 2.5"]
    spacing = [] if any("directions" in line for line in lines) else spacing
    header = "\n".join(["NRRD0005", "type: uint8", "dimension: 3", *sizes, *spacing, *lines])
    path.write_bytes(header.encode() + b"\n\n" + two_boxes().tobytes(order="F"))


@pytest.mark.parametrize(
    ("lines", "volume", "unit"),
    [
        ((), 1440, "mm"),
        (('units: "microns" "microns" "microns"',), 1440e-9, "mm"),
        (('units: "\u03bcm" "\u03bcm" "\u03bcm"',), 1440e-9, "mm"),
        (('units: "µm" "µm" "µm"',), 1440e-9, "mm"),
        (('units: "pixel" "pixel" "pixel"',), 1440, None),
    ],
)
def test_lengths_of_a_nrrd_file_are_in_its_unit(lines, volume, unit, tmp_path):
    write_nrrd(tmp_path / "x.nrrd", *lines)
    found = read_label_volume(tmp_path / "x.nrrd")
    assert found.unit == unit
    assert label_surface(found, 3).volume == pytest.approx(volume, rel=1e-3)


@pytest.mark.parametrize("lost", ["none", "(nan,nan,nan)"])
def test_a_nrrd_axis_without_a_direction_is_refused(lost, tmp_path):
    space = "space: right-anterior-superior"
    write_nrrd(tmp_path / "x.nrrd", space, "space directions: (1,0,0) (0,1.5,0) (0,0,2.5)")
    assert label_surface(read_label_volume(tmp_path / "x.nrrd"), 3).volume == pytest.approx(
        1440, rel=1e-3
    )
    write_nrrd(tmp_path / "x.nrrd", space, f"space directions: {lost} (0,1.5,0) (0,0,2.5)")
    words = r"x\.nrrd: expected directions of three axes in space, got 2"
    with pytest.raises(MeshError, match=words):
        read_label_volume(tmp_path / "x.nrrd")


@pytest.mark.parametrize("kind", ["Nifti1Pair", "Nifti2Image"])
@pytest.mark.parametrize(
    ("unit", "side"),
    [
        ("meter", 1e-3),
        ("mm", 1),
        ("micron", 1e3),
        ("unknown", 1),
    ],
)
def test_lengths_of_nifti_are_in_its_unit(kind, unit, side):
    """Pairs of a header and its voxels, too, which nibabel reads."""
    image = getattr(nibabel, kind)(
        two_boxes(),
        np.diag([side, side, side, 1.0]) @ AFFINE,
    )
    image.header.set_xyzt_units(unit)
    assert_allclose(volume_in_memory(image).affine, AFFINE, rtol=1e-6)


@pytest.mark.parametrize("order", ["RAS", "PIL"])
@pytest.mark.parametrize("suffix", ["nii.gz", "nrrd", "mha"])
def test_the_order_of_the_axes_in_a_file_is_no_matter(order, suffix, tmp_path):
    sitk.WriteImage(
        sitk.DICOMOrient(itk_image(two_boxes()), order),
        str(tmp_path / f"x.{suffix}"),
    )
    expected = label_surface(LabelVolume((two_boxes(),), AFFINE), 3)
    found = load_mesh(tmp_path / f"x.{suffix}", part="3")
    assert_allclose(found.vertices, expected.vertices, atol=1e-5)
    assert_array_equal(found.faces, expected.faces)


@pytest.mark.parametrize(
    ("space", "axes"),
    [
        ("left-posterior-superior", (-1, -1, 1)),
        ("right-anterior-superior", (1, 1, 1)),
        ("LAS", (-1, 1, 1)),
    ],
)
@pytest.mark.parametrize("last", [False, True])
def test_a_list_of_layers_in_a_nrrd_file_may_be_any_axis(space, axes, last, tmp_path):
    layers = [two_boxes() * (two_boxes() == value) for value in (3, 7)]
    columns = [*AFFINE[:3, :3].T, AFFINE[:3, 3]]
    vectors = [f"({','.join(map(str, column * axes))})" for column in columns]
    kinds = ["domain"] * 3
    directions = vectors[:3]
    kinds.insert(3 * last, "list")
    directions.insert(3 * last, "none")
    sizes = (14, 12, 10, 2) if last else (2, 14, 12, 10)
    header = f"NRRD0005\ntype: uint8\ndimension: 4\nspace: {space}\nencoding: raw\n"
    header += f"sizes: {' '.join(map(str, sizes))}\nspace directions: {' '.join(directions)}\n"
    header += f"kinds: {' '.join(kinds)}\nspace origin: {vectors[3]}\n"
    for number, (name, value) in enumerate((("liver", 3), ("spleen", 7))):
        header += f"Segment{number}_Name:={name}\nSegment{number}_LabelValue:={value}\n"
        header += f"Segment{number}_Layer:={number}\n"
    voxels = np.stack(layers, axis=3 if last else 0).tobytes(order="F")
    (tmp_path / "x.seg.nrrd").write_bytes(header.encode() + b"\n" + voxels)
    volume = read_label_volume(tmp_path / "x.seg.nrrd")
    assert label_bodies(volume) == [(3, "liver", 384), (7, "spleen", 320)]
    assert_allclose(volume.affine, AFFINE, atol=1e-9)


@pytest.mark.parametrize("name", ["x.mha", "x.nrrd", "x.nii.gz", "x.mgz"])
def test_suffixes_may_be_upper_case(name, tmp_path):
    WRITERS.get(name, write_itk)(tmp_path / name, two_boxes())
    path = (tmp_path / name).rename(tmp_path / name.upper())
    assert_array_equal(read_label_volume(path).layers[0], two_boxes())


@pytest.mark.parametrize("name", ["x.raw", "./x.raw"])
def test_voxels_beside_their_header(name, tmp_path):
    write_nrrd(tmp_path / "x.nhdr", f"data file: {name}")
    (tmp_path / "x.raw").write_bytes(two_boxes().tobytes(order="F"))
    volume = read_label_volume(tmp_path / "x.nhdr")
    assert label_bodies(volume) == [(3, "3", 384), (7, "7", 320)]
    assert label_surface(volume, 3).volume == pytest.approx(1440, rel=1e-3)
    assert dependencies_of(tmp_path / "x.nhdr") == [tmp_path / "x.nhdr", tmp_path / "x.raw"]


def test_segments_of_slicer_have_names_and_may_overlap(tmp_path):
    one = two_boxes() == 3
    two = two_boxes() > 0
    image = itk_image(
        np.stack([one, two], axis=-1).astype(np.uint8),
        vector=True,
    )
    for number, name in enumerate(("liver", "body")):
        image.SetMetaData(f"Segment{number}_Name", name)
        image.SetMetaData(f"Segment{number}_LabelValue", "1")
        image.SetMetaData(f"Segment{number}_Layer", str(number))
    sitk.WriteImage(image, str(tmp_path / "x.seg.nrrd"))
    volume = read_label_volume(tmp_path / "x.seg.nrrd")
    assert label_bodies(volume) == [(1, "liver", 384), (2, "body", 704)]
    assert label_surface(volume, "body").volume == pytest.approx(704 * 3.75, rel=1e-3)


def test_segments_of_slicer_before_4_11_each_have_a_layer(tmp_path):
    """It wrote no values and no layers; names are on one line, as in every table."""
    layers = np.stack(
        [two_boxes() == 3, two_boxes() > 0],
        axis=-1,
    )
    image = itk_image(layers.astype(np.uint8), vector=True)
    for number, name in enumerate(("left  kidney ", "body")):
        image.SetMetaData(f"Segment{number}_Name", name)
        image.SetMetaData(f"Segment{number}_ID", f"Segment_{number + 1}")
    sitk.WriteImage(image, str(tmp_path / "x.seg.nrrd"))
    bodies = label_bodies(read_label_volume(tmp_path / "x.seg.nrrd"))
    assert bodies == [(1, "left kidney", 384), (2, "body", 704)]
    one = itk_image((two_boxes() == 3).astype(np.uint8))
    one.SetMetaData("Segment0_Name", "liver")
    sitk.WriteImage(one, str(tmp_path / "y.seg.nrrd"))
    assert label_bodies(read_label_volume(tmp_path / "y.seg.nrrd")) == [(1, "liver", 384)]


@pytest.mark.parametrize("overlap", [False, True])
def test_segments_of_dicom_have_names_and_may_overlap(overlap, tmp_path):
    masks = masks_of(two_boxes())
    masks[..., 1] |= overlap * masks[..., 0]
    write_segmentation(tmp_path / "x.dcm", masks, ["liver", "spleen"], "BINARY")
    bodies = label_bodies(read_label_volume(tmp_path / "x.dcm"))
    expected = [
        (1, "liver", 384),
        (2, "spleen", 704 if overlap else 320),
    ]
    assert bodies == expected


@pytest.mark.parametrize("most", [255, 100])
def test_fractional_segments_of_dicom_are_cut_at_the_threshold(most, tmp_path):
    """Three that overlap, in other slices each, the last all or nothing; the frames are read by pydicom."""
    place = np.moveaxis(
        np.indices((24, 20, 16)),
        0,
        -1,
    )
    soft = (((9, 9, 6), 5), ((14, 10, 9), 4))
    shares = []
    for centre, radius in soft:
        shares.append(
            np.clip(
                1.5 - norm(place - centre, axis=-1) / radius,
                0,
                1,
            )
        )
    shares.append(norm(place - (8, 9, 8), axis=-1) < 4)
    names = ["liver", "tumour  (left)", "vessel"]
    path = tmp_path / "x.dcm"
    masks = np.stack(shares, axis=-1).astype(np.float32)
    write_segmentation(path, masks, names, "FRACTIONAL", "PROBABILITY", most)
    import pydicom

    dataset = pydicom.dcmread(path)
    assert dataset.MaximumFractionalValue == most
    shared = dataset.SharedFunctionalGroupsSequence[0]
    axes = np.reshape(shared.PlaneOrientationSequence[0].ImageOrientationPatient, (2, 3)).astype(
        float
    )
    between_rows, between_columns = (
        float(side) for side in shared.PixelMeasuresSequence[0].PixelSpacing
    )
    thick = float(shared.PixelMeasuresSequence[0].SpacingBetweenSlices)
    for threshold in (0.5, 0.25, 0.9):
        volume = read_label_volume(path, LoadOptions(threshold=threshold))
        found = {}
        for part in volume.bodies:
            index = np.argwhere(volume.mask(part.label)) + [side.start for side in part.box]
            found[part.name] = index @ volume.affine[:3, :3].T + volume.affine[:3, 3]
        assert list(found) == ["liver", "tumour (left)", "vessel"]
        assert abs(np.linalg.det(volume.affine)) == pytest.approx(
            between_rows * between_columns * thick
        )
        for number, points in enumerate(found.values(), 1):
            expected = []
            for frame, about in zip(
                dataset.pixel_array, dataset.PerFrameFunctionalGroupsSequence, strict=True
            ):
                if about.SegmentIdentificationSequence[0].ReferencedSegmentNumber == number:
                    row, column = np.nonzero(frame >= threshold * most)
                    corner = np.array(
                        about.PlanePositionSequence[0].ImagePositionPatient, dtype=float
                    )
                    steps = np.stack([column * between_columns, row * between_rows], axis=1)
                    expected.append((corner + steps @ axes) * [-1, -1, 1])
            sets = [
                np.unique(np.round(one, 2), axis=0) for one in (points, np.concatenate(expected))
            ]
            assert_allclose(*sets, atol=0.02)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        (
            "x.label",
            '# ITK-SnAP\n    0     0    0    0        0  0  0    "Clear"\n    3   255    0    0   1  1  1    "a b"\n',
        ),
        ("x.ctbl", "# Color table\n3 a_b 10 20 30 255\n"),
        ("FreeSurferColorLUT.txt", "#No. Label Name: R G B A\n\n3   a_b      70  130 180 0\n"),
        ("x.lut", "0 0.0 0.0 0.0 Unknown\n3  0.80392 0.24314 0. a b\n"),  # FSLeyes
        ("x.csv", "LabelValue,Name,Color_R\n3,a b,1\n"),
        ("x.csv", "index\tname\tabbreviation\n3\ta b\tA\n"),
        ("x.tsv", "index\tname\tabbreviation\n3\ta b\tA\n"),  # BIDS
        ("dataset.json", json.dumps({"labels": {"background": 0, "a b": 3}})),
        ("x.json", json.dumps({"3": "a b"})),
    ],
)
def test_a_table_beside_the_volume_names_its_labels(name, text, tmp_path):
    write_nibabel(tmp_path / "x.nii.gz", two_boxes())
    (tmp_path / name).write_text(text)
    named, plain = read_label_volume(tmp_path / "x.nii.gz").bodies
    assert named.name.replace("_", " ") == "a b"
    assert plain.name == "7"


def test_names_of_fsleyes_are_the_rest_of_the_line_and_colours_are_none(tmp_path):
    (tmp_path / "x.lut").write_text(
        "2 0.0 1.0 0.5 3rd ventricle\n3  0.80392 0.24314 0. Left Caudate\n"
    )
    assert read_label_names(tmp_path / "x.lut") == {2: "3rd ventricle", 3: "Left Caudate"}
    # Index, name, colours
    (tmp_path / "teeth.lut").write_text("2 11 10 20 30 255\n3 21 10 20 30\n")
    assert read_label_names(tmp_path / "teeth.lut") == {2: "11", 3: "21"}


def test_names_come_from_the_header_and_a_given_table_goes_first(tmp_path):
    image = nibabel.Nifti1Image(two_boxes(), AFFINE)
    xml = b'<LabelTable><Label Key="3" Red="1"><![CDATA[left & right]]></Label></LabelTable>'
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, xml))
    nibabel.save(image, tmp_path / "x.nii.gz")
    told = read_label_volume(tmp_path / "x.nii.gz")
    assert [body.name for body in told.bodies] == ["left & right", "7"]
    (tmp_path / "names.csv").write_text("label,name\n7,spleen\n")
    given = read_label_volume(tmp_path / "x.nii.gz", LoadOptions(names=str(tmp_path / "names.csv")))
    assert [body.name for body in given.bodies] == ["3", "spleen"]


def test_a_mask_without_names_is_called_by_its_file(tmp_path):
    write_nibabel(tmp_path / "left.kidney.nii.gz", (two_boxes() == 3).astype(np.uint8))
    volume = read_label_volume(tmp_path / "left.kidney.nii.gz")
    assert label_bodies(volume) == [(1, "left.kidney", 384)]
    (tmp_path / "left.kidney.csv").write_text("label,name\n1,kidney\n")
    assert label_bodies(read_label_volume(tmp_path / "left.kidney.nii.gz")) == [(1, "kidney", 384)]


def test_a_mask_of_255_is_called_by_its_file_too(tmp_path):
    write_nibabel(
        tmp_path / "prostate.nii.gz",
        (two_boxes() == 3).astype(np.uint8) * 255,
    )
    assert label_bodies(read_label_volume(tmp_path / "prostate.nii.gz")) == [(255, "prostate", 384)]
    labels = np.select([two_boxes() == 3, two_boxes() == 7], [255, 254]).astype(np.uint8)
    write_nibabel(tmp_path / "labels.nii.gz", labels)
    bodies = label_bodies(read_label_volume(tmp_path / "labels.nii.gz"))
    assert bodies == [(254, "254", 320), (255, "255", 384)]


def test_labels_that_were_given_as_numbers_with_a_fraction_are_whole_again(tmp_path):
    """nibabel writes them as scaled integers where the header of an image of integers comes with them."""
    image = nibabel.Nifti1Image(two_boxes() * 1.0, AFFINE)
    image.header.set_data_dtype(np.int16)
    nibabel.save(image, tmp_path / "x.nii.gz")
    stored = np.asanyarray(nibabel.load(tmp_path / "x.nii.gz").dataobj)
    assert (stored != np.round(stored)).any()
    assert label_bodies(read_label_volume(tmp_path / "x.nii.gz")) == [(3, "3", 384), (7, "7", 320)]


def test_probabilities_are_cut_at_the_threshold(tmp_path):
    ball = norm(
        np.indices((20, 20, 20)) - 9.5,
        axis=0,
    )
    shares = np.clip(1.5 - ball / 8, 0, 1).astype(np.float32)
    write_nifti(tmp_path / "x.nii", shares)
    radius = {}
    for threshold in (0.5, 0.75):
        volume = read_label_volume(tmp_path / "x.nii", LoadOptions(threshold=threshold))
        mesh = label_surface(volume, 1)
        radius[threshold] = (mesh.volume * 3 / 4 / np.pi) ** (1 / 3)
        assert any("probabilities" in note for note in mesh.notes)
    assert radius == pytest.approx({0.5: 8, 0.75: 6}, rel=0.02)
    shares = np.clip(0.9 - ball / 8, 0, 1).astype(np.float32)
    write_nifti(tmp_path / "y.nii", shares)
    words = r"no voxel has a label, all are 0 \(probabilities: .* from 0\.95 on\)\. Check"
    with pytest.raises(MeshError, match=words):
        read_label_volume(tmp_path / "y.nii", LoadOptions(threshold=0.95))


@pytest.mark.parametrize("order", ["C", "F"])
def test_labels_as_floating_point_numbers_take_no_more_memory_than_is_asked_for(order):
    labels = np.zeros((120, 120, 120), order=order)
    labels[20:90, 30:80, 10:100] = 7
    labels[100:110] = 300.004
    tracemalloc.start()
    volume = volume_in_memory(labels, (1, 1, 1))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    expected = [
        (7, "7", 70 * 50 * 90),
        (300, "300", 10 * 120 * 120),
    ]
    assert label_bodies(volume) == expected
    assert peak < 4 * labels.size


@pytest.mark.parametrize("dtype", [np.uint8, np.float64])
def test_an_array_without_voxels_is_refused_in_a_sentence(dtype):
    words = r"^crop: expected labels of shape \(X, Y, Z\).* of shape \(0, 3, 3\)"
    with pytest.raises(MeshError, match=words):
        volume_in_memory(np.zeros((0, 3, 3), dtype), name="crop")


def test_probabilities_may_overshoot(tmp_path):
    """SPM keeps them as bytes times 1/255 in single precision, so that the largest is more than 1."""
    ball = norm(
        np.indices((20, 20, 20)) - 9.5,
        axis=0,
    )
    share = np.clip(1.5 - ball / 8, 0, 1)
    image = nibabel.Nifti1Image(
        np.round(share * 255).astype(np.uint8),
        np.eye(4),
    )
    header = bytearray(image.header.binaryblock)
    header[108:120] = np.array([352, 1 / 255, 0], dtype="<f4").tobytes()
    header[344:348] = b"n+1\0"
    (tmp_path / "x.nii").write_bytes(header + bytes(4) + image.dataobj.tobytes(order="F"))
    assert np.asarray(nibabel.load(tmp_path / "x.nii").dataobj).max() > 1
    below = (share - 1e-6 * (share == 0)).astype(np.float32)
    write_nifti(tmp_path / "y.nii", below)
    for name in ("x.nii", "y.nii"):
        (body,) = read_label_volume(tmp_path / name).bodies
        assert body.n_voxels == (ball <= 8).sum()


def test_large_labels_are_kept(tmp_path):
    labels = two_boxes().astype(np.int32) * 100_000_000
    write_nifti(tmp_path / "x.nii.gz", labels, AFFINE)
    volume = read_label_volume(tmp_path / "x.nii.gz")
    assert label_bodies(volume) == [
        (300_000_000, "300000000", 384),
        (700_000_000, "700000000", 320),
    ]
    assert label_surface(volume, 700_000_000).volume == pytest.approx(320 * 3.75, rel=1e-3)


def nifti(path, values, affine=AFFINE):
    write_nifti(path, values, affine)


def cut_short(path):
    nifti(
        path,
        default_rng(0).integers(0, 3, (40, 40, 40)).astype(np.uint8),
    )
    path.write_bytes(path.read_bytes()[:3000])


def huge(path):
    """The header claims more voxels than the file has."""
    nifti(path, two_boxes())
    content = bytearray(gzip.decompress(path.read_bytes()))
    content[40:48] = np.array([3, 32767, 32767, 32767], dtype="<i2").tobytes()
    path.write_bytes(gzip.compress(content))


def singular(path):
    """The affine has two equal rows."""
    labels = two_boxes()
    image = nibabel.Nifti1Image(labels, AFFINE)
    image.header["sform_code"] = 1
    image.header["qform_code"] = 0
    image.header["srow_x"] = image.header["srow_y"]
    with gzip.open(path, "wb") as file:
        file.write(image.header.binaryblock + bytes(4) + labels.tobytes(order="F"))


def unusable_values():
    """Arrays that are no labels, by what they are."""
    labels = two_boxes()
    scan = default_rng(0).normal(
        120,
        15,
        (40, 40, 40),
    )
    scan[:20] = 24  # a background that is not 0
    return {
        "4D": np.stack([labels, labels], axis=-1),
        "colours": np.zeros(
            (4, 4, 4),
            dtype=[("R", "u1"), ("G", "u1"), ("B", "u1")],
        ),
        "complex": labels.astype(np.complex64),
        "NaN": np.where(labels == 3, np.nan, labels).astype(np.float32),
        "negative": labels.astype(np.int16) - 1,
        "fractional": labels.astype(np.float32) / 2,
        "one slice": labels[:, :, 3:4],
        "no label": labels * np.uint8(0),
        "bytes": scan.astype(np.uint8),
        "image": np.arange(40**3).reshape(40, 40, 40).astype(np.int32),
    }


UNUSABLE_FILES = {"cut short": cut_short, "huge": huge, "singular": singular}


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("cut short", "not readable as a label volume.*complete"),
        ("huge", "35,181,150,961,663 voxels need .* GB of memory.*damaged"),
        ("4D", "4 axes.*each volume"),
        ("colours", "colours.*Export the labels"),
        ("complex", "complex numbers.*Export the labels"),
        ("NaN", "384 voxels are NaN.*Set them to 0"),
        ("negative", "negative labels, such as -1.*Export"),
        ("fractional", "fractional labels, such as [13].5.*nearest"),
        ("one slice", "single slice.*whole stack"),
        ("no label", "no voxel has a label"),
        ("singular", "affine.*singular.*Write the file again"),
        ("image", "look like an image"),
        ("bytes", "look like an image and not like labels. Export the labels"),
    ],
)
def test_what_is_no_label_volume_is_refused_in_a_sentence(kind, words, tmp_path):
    path = tmp_path / "x.nii.gz"
    if kind in UNUSABLE_FILES:
        UNUSABLE_FILES[kind](path)
    else:
        nifti(path, unusable_values()[kind])
    with pytest.raises(MeshError, match=f"^{re.escape(str(path))}: .*{words}"):
        read_label_volume(path)


def test_many_labels_as_small_as_they_may_be_are_no_image():
    block = np.repeat(
        np.repeat(np.repeat(np.arange(1, 217).reshape(6, 6, 6), 2, 0), 2, 1),
        2,
        2,
    )
    assert {body.n_voxels for body in LabelVolume((block,), np.eye(4)).bodies} == {8}


def test_a_label_in_pieces_is_one_body_on_its_own_grid():
    """Of 2 × 12³ voxels at a distance of six; a grid made for the mesh would say so in its note."""
    labels = np.zeros((32, 14, 14), dtype=int)
    labels[1:13, 1:13, 1:13] = 1
    labels[19:31, 1:13, 1:13] = 1
    volume = LabelVolume((labels,), np.eye(4))
    body = label_surface(volume, 1)
    assert body.notes == ("joined 2 pieces by bars",)
    assert body.volume == pytest.approx(2 * 12**3, rel=0.02)
    with pytest.raises(MeshError, match=r"volume#1: .*2 "):
        label_surface(volume, 1, how="never")


def test_labels_of_one_name_are_told_apart_by_their_numbers(tmp_path):
    labels = two_boxes()
    labels[0, 0:8, 0:3] = 5
    nifti(tmp_path / "x.nii", labels)
    (tmp_path / "x.csv").write_text("label,name\n3,rib\n5,liver\n7,rib\n")
    volume = read_label_volume(tmp_path / "x.nii")
    names = [(body.label, body.name) for body in volume.bodies]
    assert names == [(3, "rib (3)"), (5, "liver"), (7, "rib (7)")]
    rib = label_surface(volume, "rib (7)")
    expected = pytest.approx(
        (labels == 7).sum() * 3.75,
        rel=1e-3,
    )
    assert rib.volume == expected
    assert rib.notes == ()
    words = r"x\.nii: no label 'rib'\. It has 3: rib \(3\), liver, rib \(7\)"
    with pytest.raises(MeshError, match=words):
        volume.body("rib")
    with pytest.raises(MeshError, match=r"labels 3 and 5 are both named 'rib \(3\)'.*Rename"):
        LabelVolume(
            (labels,),
            AFFINE,
            names={3: "rib", 7: "rib", 5: "rib (3)"},
        )


def test_a_name_that_is_the_number_of_another_label_is_the_name(tmp_path):
    """Dentists call teeth by numbers."""
    nifti(tmp_path / "x.nii", two_boxes())
    (tmp_path / "x.csv").write_text("label,name\n3,11\n7,3\n")
    volumes = {ref.part: mesh.volume for ref, mesh in each_body(tmp_path / "x.nii")}
    expected = pytest.approx(
        {"11": 384 * 3.75, "3": 320 * 3.75},
        rel=1e-3,
    )
    assert volumes == expected
    assert load_mesh(tmp_path / "x.nii", part="3").volume == pytest.approx(320 * 3.75, rel=1e-3)
    volume = read_label_volume(tmp_path / "x.nii")
    assert [volume.body(part).label for part in (3, 7, "7", "3")] == [3, 7, 7, 7]


def test_pieces_of_a_volume_are_what_does_not_touch_whatever_its_label(tmp_path):
    """Each with the volume of its voxels; they were joined by bars to one."""
    labels = np.pad(
        two_boxes(),
        ((0, 16), (0, 0), (0, 0)),
    )
    labels[20:28, 2:10, 1:9] = 3
    labels[16, 0, 0:3] = 3
    nifti(tmp_path / "x.nii", labels)
    options = LoadOptions(bodies="pieces")
    assert [ref.part for ref in list_bodies(tmp_path / "x.nii", options)] == ["piece 1", "piece 2"]
    for part, n_voxels in (("piece 1", 384 + 320), ("piece 2", 512)):
        mesh = load_mesh(tmp_path / "x.nii", options, part=part)
        assert mesh.volume == pytest.approx(n_voxels * 3.75, rel=1e-3)
        assert mesh.notes == ("left out 1 speck",)
        assert mesh.unit == "mm"
    with pytest.raises(MeshError, match="2 connected components"):
        load_mesh(tmp_path / "x.nii", LoadOptions(bodies="whole", mend="never"))
    nifti(
        tmp_path / "y.nii",
        labels * (np.arange(30) == 16)[:, None, None].astype(np.uint8),
    )
    with pytest.raises(MeshError, match=r"y\.nii#piece 1: expected at least 8 voxels, got 3"):
        load_mesh(tmp_path / "y.nii", options)


def test_one_small_label_leaves_the_others():
    labels = two_boxes()
    labels[13, 3:10, 5] = 9
    volume = LabelVolume((labels,), AFFINE, name="x.nii")
    with pytest.raises(MeshError, match=r"^x\.nii#9: expected at least 8 voxels, got 7"):
        label_surface(volume, 9)
    assert label_surface(volume, 3).volume > 0
    with pytest.raises(MeshError, match=r"^x\.nii: no label 'heart'. It has 3: 3, 7, 9\."):
        label_surface(volume, "heart")


def test_no_header_leads_out_of_its_folder(tmp_path):
    write_itk(tmp_path / "x.mhd", two_boxes())
    text = (tmp_path / "x.mhd").read_text()
    elsewhere = re.sub("ElementDataFile = .*", "ElementDataFile = ../../etc/passwd", text)
    (tmp_path / "x.mhd").write_text(elsewhere)
    with pytest.raises(MeshError, match="expected voxels in a file of the same folder"):
        read_label_volume(tmp_path / "x.mhd")
    header = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 4 4 4\nencoding: raw\ndata file: /etc/passwd\n\n"
    (tmp_path / "x.nrrd").write_text(header)
    with pytest.raises(MeshError, match="expected voxels in a file of the same folder"):
        read_label_volume(tmp_path / "x.nrrd")


@pytest.mark.parametrize(
    "line", ["\n\nElementDataFile =", " ElementDataFile =", "ElementDataFile :"]
)
def test_no_header_of_metaimage_leads_out_however_it_is_written(line, tmp_path):
    """ITK reads these, too."""
    write_itk(tmp_path / "x.mhd", two_boxes())
    (tmp_path / "below").mkdir()
    text = (tmp_path / "x.mhd").read_text().replace("ElementDataFile = ", f"{line} ../")
    (tmp_path / "below" / "x.mhd").write_text(text)
    assert sitk.GetArrayFromImage(sitk.ReadImage(str(tmp_path / "below" / "x.mhd"))).any()
    with pytest.raises(MeshError, match="expected voxels in a file of the same folder"):
        read_label_volume(tmp_path / "below" / "x.mhd")


def test_dicom_that_is_no_segmentation_is_refused(tmp_path):
    path = Path(nibabel.__file__).parent / "tests" / "data" / "0.dcm"
    if not path.is_file():
        pytest.skip("nibabel is installed without its test data")
    with pytest.raises(MeshError, match="expected DICOM of modality SEG, got "):
        read_label_volume(path)


def test_contours_of_radiotherapy_are_refused_with_what_converts_them(tmp_path):
    pydicom = pytest.importorskip("pydicom", reason="the extra [volumes]")
    dataset = pydicom.Dataset()
    dataset.Modality = "RTSTRUCT"
    dataset.SOPClassUID = "1.2.840.10008.5.1.4.1.1.481.3"
    dataset.SOPInstanceUID = pydicom.uid.generate_uid()
    dataset.file_meta = pydicom.dataset.FileMetaDataset()
    dataset.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    path = tmp_path / "rs.dcm"
    dataset.save_as(path, enforce_file_format=True)
    with pytest.raises(MeshError, match=r"contours and no voxels.*dcmrtstruct2nii convert -r rs"):
        read_label_volume(path)


def test_a_table_that_names_nothing_is_refused(tmp_path):
    (tmp_path / "names.txt").write_text("hello\n")
    with pytest.raises(MeshError, match="names no label"):
        read_label_names(tmp_path / "names.txt")
    with pytest.raises(MeshError, match="Check the path"):
        read_label_names(tmp_path / "missing.txt")


def test_thin_branches_are_not_taken_for_noise():
    """A tree of vessels two voxels wide, whose corners are as rough as a scanner's noise, has the voxels' volume."""
    random = default_rng(3)
    mask = np.zeros((96, 96, 96), dtype=np.uint8)
    ends = [np.array([48.0, 48.0, 4.0])]
    for _ in range(60):
        start = ends[random.integers(len(ends))]
        ends.append(
            np.clip(
                start + random.normal(0, 18, 3),
                4,
                91,
            )
        )
        way = np.linspace(start, ends[-1], 200)
        for at in np.round(way).astype(int):
            mask[tuple(slice(i, i + 2) for i in at)] = 1
    mesh = label_surface(
        LabelVolume((mask,), np.eye(4)),
        1,
    )
    assert mesh.volume == pytest.approx(mask.sum(), rel=2e-3)
    assert mesh.notes == ()
