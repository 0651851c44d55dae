"""Options for reading a file as bodies."""

import math
import os
from dataclasses import asdict, dataclass
from typing import Literal, get_args

from igps._parameters import check_at_least, check_one_of

Mending = Literal["auto", "never", "always"]
Cavities = Literal["fill", "keep"]
BodyKind = Literal["whole", "labels", "objects", "pieces", "chains", "models", "assembly"]

MAX_UNPACKED = 2**30
"""Default limit, in bytes, of the unpacked size of a compressed file, an archive or repeated objects."""


@dataclass(frozen=True)
class LoadOptions:
    """Options for reading a file: what counts as a body, and how its surface is repaired.

    Example:
        >>> import tempfile, trimesh
        >>> from igps.mesh.loading import load_mesh
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     loose = trimesh.creation.box((1, 2, 3))
        ...     loose.unmerge_vertices()
        ...     _ = loose.export(f"{folder}/box.off")
        ...     load_mesh(f"{folder}/box.off", LoadOptions()).notes
        ('welded 28 coincident vertices',)

    Args:
        mend: "auto" makes as few repairs as possible; "never" raises an error for a surface that bounds no body;
            "always" makes every surface watertight that crosses itself or does not bound a single body, for collections
            of mixed quality.
        allow_open: accept open boundaries; the winding number then tells inside from outside.
        bodies: what counts as a body: "whole" (the file), "labels" (of a volume), "objects" (of a scene, solids of a
            CAD file, files of an archive), "pieces" (connected components), or "chains", "models" or "assembly" (of a
            molecule). None, or a kind that the format does not have, selects labels, chains, or else the whole file.
        max_unpacked: largest unpacked size of a file, in bytes.
        names: file with a table of label names, see `read_label_names`; None for the names in or beside the volume. Or
            "freesurfer", "totalsegmentator" or "totalsegmentator_v1": the names of their labels, for other volumes.
        threshold: smallest value of the voxels of a body, in volumes of probabilities, where None is 0.5, and in maps
            of density, which need it.
        cavities: "fill" fills hollow bodies; "keep" makes the surfaces of hollows part of their boundary.
        first_model: take only the first model of each file of molecules.
        min_plddt: leave out residues of predicted molecules whose pLDDT, in place of the B-factor, is lower.

    Raises:
        ValueError: an invalid value.
    """

    mend: Mending = "auto"
    allow_open: bool = False
    bodies: BodyKind | None = None
    max_unpacked: int = MAX_UNPACKED
    names: str | None = None
    threshold: float | None = None
    cavities: Cavities = "fill"
    first_model: bool = False
    min_plddt: float | None = None

    def __post_init__(self) -> None:
        check_one_of(get_args(Mending), mend=self.mend)
        check_one_of(get_args(Cavities), cavities=self.cavities)
        check_one_of((*get_args(BodyKind), None), bodies=self.bodies)
        check_at_least(1, max_unpacked=self.max_unpacked)
        if self.allow_open and self.mend == "always":
            raise ValueError(
                'allow_open: expected False with mend="always", which closes every surface. '
                "Leave one of them out."
            )
        if self.min_plddt is not None and not 0 < self.min_plddt <= 100:
            raise ValueError(f"min_plddt: expected above 0 and at most 100, got {self.min_plddt}.")
        if self.threshold is not None and not math.isfinite(self.threshold):
            raise ValueError(f"threshold: expected a finite number, got {self.threshold}.")

    @property
    def names_anywhere(self) -> str | None:
        """The table of names as it is found from any folder."""
        is_file = self.names is not None and os.path.isfile(self.names)
        return os.path.abspath(self.names) if is_file and self.names else self.names

    def as_dict(self) -> dict[str, object]:
        """Return the options on which a body depends, for cache keys."""
        options = asdict(self)
        del options["max_unpacked"], options["names"]
        return options
