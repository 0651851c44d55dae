"""How a file is read, and which bodies it gives."""

from dataclasses import asdict, dataclass
from typing import Literal, get_args

from igps._parameters import check_at_least, check_one_of
from igps.mesh.mending import Cavities, Mending

Component = Literal["largest"]
BodyKind = Literal["whole", "labels", "objects", "pieces", "chains", "models", "assembly"]

MAX_UNPACKED = 2**30
"""Bytes that a compressed file, an archive or repeated objects may unpack to, by default."""


@dataclass(frozen=True)
class LoadOptions:
    """How a file is read.

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
        mend: "auto" does the least that makes a body of the surface; "never" refuses what is no body;
            "always" makes every surface watertight that does not bound one body without crossing itself, for
            collections of mixed quality.
        component: "largest" keeps only the connected component of the largest area.
        allow_open: accept open boundaries; the winding number then decides what is inside.
        bodies: what of a file is a body. "whole": all of it; "labels" of a volume; "objects" of a scene, solids of a
            CAD file, files of an archive; "pieces": what is not connected; "chains", "models" or the "assembly" of a
            molecule. None takes labels, chains, or else the whole; so does a kind that the format does not have.
        max_unpacked: bytes that a file may unpack to.
        names: a table of the names of labels, see `read_label_names`; None for those of the volume, or beside it.
        threshold: a voxel of at least this probability belongs to the body, in volumes of probabilities.
        cavities: "fill" fills hollow bodies; "keep" lets the surfaces of their hollows bound them too.

    Raises:
        ValueError: an unknown value.
    """

    mend: Mending = "auto"
    component: Component | None = None
    allow_open: bool = False
    bodies: BodyKind | None = None
    max_unpacked: int = MAX_UNPACKED
    names: str | None = None
    threshold: float = 0.5
    cavities: Cavities = "fill"

    def __post_init__(self) -> None:
        check_one_of(get_args(Mending), mend=self.mend)
        check_one_of(get_args(Cavities), cavities=self.cavities)
        check_one_of((*get_args(Component), None), component=self.component)
        check_one_of((*get_args(BodyKind), None), bodies=self.bodies)
        check_at_least(1, max_unpacked=self.max_unpacked)
        if not 0 < self.threshold <= 1:
            raise ValueError(f"threshold: expected above 0 and at most 1, got {self.threshold}.")

    def as_dict(self) -> dict[str, object]:
        """The options on which a body depends, for the keys of caches; the later ones only where not default."""
        later = {"bodies": None, "threshold": 0.5, "cavities": "fill"}
        options = {name: value for name, value in asdict(self).items() if name not in ("max_unpacked", "names")}
        return {name: value for name, value in options.items() if name not in later or value != later[name]}
