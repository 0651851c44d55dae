"""The descriptors as a scikit-learn transformer."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.utils.validation import check_is_fitted

from igps._arrays import Singles
from igps.analysis.inside import column_names
from igps.analysis.inside_collection import inside_config, inside_table
from igps.data.added_attributes import AttributeSource
from igps.data.attribute_sources import attribute_sources
from igps.data.collation import collate
from igps.data.dataset import SignatureDataset
from igps.descriptors import descriptor as descriptor_of
from igps.descriptors.fingerprint import cache_tag
from igps.mesh.mesh import Mesh
from igps.mesh.options import LoadOptions
from igps.nn.description import describe
from igps.nn.descriptor import Descriptor, HistogramDescriptor
from igps.signature.signature import SignatureConfig, compute_signature


class VolumetricFeatures(TransformerMixin, BaseEstimator):
    """Transformer of mesh files or meshes to descriptions, one row each. Nothing is fitted.

    By default, cells of histograms are replaced by their square roots, whose Euclidean distance is the Hellinger
    distance, as linear classifiers and Gaussian kernels need it. For a χ² kernel, set `square_root=False`.

    Example:
        >>> from igps import ArticulatedShapes, Mesh
        >>> shape = ArticulatedShapes(n_vertices=600)[0]
        >>> features = VolumetricFeatures("interior").fit([Mesh(shape.vertices, shape.faces)])
        >>> features.get_feature_names_out()[-1]
        'interior639'

    Args:
        descriptor: a name, "package.module:NAME", or a `Descriptor`; see `igps.descriptor`.
        square_root: take square roots of the cells of histograms. Other descriptions are unchanged.
        inside: attributes of mesh files whose numbers of `igps inside` follow the description, NaN where a number is
            not defined. Each is a definition, such as "ct=ct/{stem}.nii.gz" with a path from the folder of the file,
            or the name of an attribute that the file itself has, such as "charge".
        config: configuration of the signatures, completed by the requirements of the descriptor; the default if None.
        reading: options for reading mesh files.
        cache_dir: cache of the signatures of mesh files; the user's cache directory if None. Meshes are not cached.
        n_workers: number of processes that compute the signatures of mesh files; the number of cores if None.
    """

    def __init__(
        self,
        descriptor: str | Descriptor = "pretrained",
        *,
        square_root: bool = True,
        inside: Sequence[str] = (),
        config: SignatureConfig | None = None,
        reading: LoadOptions | None = None,
        cache_dir: str | Path | None = None,
        n_workers: int | None = None,
    ) -> None:
        self.descriptor = descriptor
        self.square_root = square_root
        self.inside = inside
        self.config = config
        self.reading = reading
        self.cache_dir = cache_dir
        self.n_workers = n_workers

    def fit(self, X: Sequence[str | Path | Mesh], y: Any = None) -> Self:
        """Check the parameters and the input, and determine the number of columns."""
        chosen = descriptor_of(self.descriptor)
        shapes = _checked(X)
        self._name = chosen.name
        self._inside_names = column_names(list(self._sources()))
        if isinstance(chosen, HistogramDescriptor):
            self._n_features_out = chosen.n_features + len(self._inside_names)
        else:  # known only after describing a shape
            self._n_features_out = self._features(shapes[:1]).shape[1]
        return self

    def transform(self, X: Sequence[str | Path | Mesh]) -> Singles:
        """Return features (N, cells) of N mesh files or N meshes.

        Raises:
            MeshError: a mesh cannot be used, see `load_mesh`.
            TypeError: the input is neither paths nor meshes.
        """
        return self._features(_checked(X))

    def get_feature_names_out(self, input_features: Any = None) -> NDArray[np.object_]:
        """Return the names of the columns: the name of the descriptor with an index, and the numbers inside.

        Args:
            input_features: ignored, because meshes have no columns.

        Raises:
            NotFittedError: before `fit`.
        """
        check_is_fitted(self, "_n_features_out")
        n_described = self._n_features_out - len(self._inside_names)
        described = [f"{self._name}{i}" for i in range(n_described)]
        return np.array([*described, *self._inside_names], dtype=object)

    def _sources(self) -> dict[str, AttributeSource]:
        if isinstance(self.inside, str):
            raise TypeError(f"inside: expected a list of attributes, got {self.inside!r} alone.")
        # The name of an attribute that the file itself has stands for its definition, too
        definitions = [text if "=" in text else f"{text}={text}" for text in self.inside]
        return attribute_sources(definitions, None)

    def _features(self, shapes: list[Any]) -> Singles:
        chosen = descriptor_of(self.descriptor)
        if isinstance(shapes[0], Mesh):
            config = chosen.requirements.apply_to(self.config or SignatureConfig())
            with torch.inference_mode():
                parts = [
                    chosen(collate([compute_signature(mesh, config)], [mesh])) for mesh in shapes
                ]
            features = torch.cat(parts)
        else:
            dataset = SignatureDataset(
                shapes, self.config, self.cache_dir, descriptor=chosen, reading=self.reading
            )
            if len(dataset) != len(shapes):
                part = next(
                    name for name in dataset.bodies.names if name not in set(map(str, shapes))
                )
                raise ValueError(
                    f"X: expected files of one body, got several, such as {part}. Name each as FILE#PART."
                )
            dataset.precompute(n_workers=self.n_workers, strict=True, progress=False)
            features = describe(
                dataset, chosen, cache_tag=cache_tag(chosen), n_workers=self.n_workers
            )
        cells = features.flatten(1)
        if self.square_root and isinstance(chosen, HistogramDescriptor):
            # Not the size of molecules, which follows the cells
            cells[:, : sum(chosen.part_cells)].sqrt_()
        sources = self._sources()
        if not sources:
            return cells.numpy()
        return np.hstack([cells.numpy(), self._inside(shapes, sources)])

    def _inside(self, shapes: list[Any], sources: dict[str, AttributeSource]) -> Singles:
        """Return the numbers (N, ...) that tell where inside N mesh files their attributes lie."""
        if isinstance(shapes[0], Mesh):
            raise ValueError(
                "X: expected mesh files with `inside`, got meshes. Give files, or use igps.inside."
            )
        config = inside_config(self.config or SignatureConfig())
        dataset = SignatureDataset(
            shapes, config, self.cache_dir, reading=self.reading, attributes=sources
        )
        dataset.precompute(n_workers=self.n_workers, strict=True, progress=False)
        table = inside_table(dataset, list(sources), n_workers=self.n_workers)
        return table.rows.astype(np.float32)

    def __sklearn_is_fitted__(self) -> bool:
        return True

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.two_d_array = False
        tags.input_tags.string = True
        tags.no_validation = True
        tags.transformer_tags.preserves_dtype = []
        tags.requires_fit = False
        return tags


def _checked(shapes: Sequence[str | Path | Mesh]) -> list[Any]:
    if isinstance(shapes, str | Path):
        raise TypeError(
            f"X: expected a list of paths of mesh files, or of meshes, got {str(shapes)!r} alone."
        )
    table = np.asarray(shapes, dtype=object)  # a list of a table would be its column names
    if table.shape[1:] not in ((), (1,)):
        raise ValueError(
            f"X: expected one column of paths or meshes, got an array of shape {table.shape}."
        )
    items = list(table.ravel())
    are_paths = all(isinstance(item, str | Path) for item in items)
    are_meshes = all(isinstance(item, Mesh) for item in items)
    if not items or not (are_paths or are_meshes):
        names = sorted({type(item).__name__ for item in items}) or ["nothing"]
        raise TypeError(f"X: expected paths of mesh files, or meshes, got {', '.join(names)}.")
    return items
