"""Label volumes and images in files of NIfTI."""

import numpy as np
import pytest

nibabel = pytest.importorskip("nibabel", reason="the extra [volumes]")


MILLIMETRES = np.eye(4)


def write_nifti(path, voxels, affine=MILLIMETRES):
    """Write an array (X, Y, Z), by default with voxels of 1 mm, and the folder that it needs."""
    path.parent.mkdir(parents=True, exist_ok=True)
    nibabel.save(nibabel.Nifti1Image(voxels, affine), path)
