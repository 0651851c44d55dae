"""Where inside a labelled body an image lies, as a dictionary transform of MONAI (the extra `monai`)."""

from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np

from igps.analysis.inside import column_names
from igps.analysis.inside_objects import inside

try:
    from monai.transforms import MapTransform
except ImportError as error:
    _MISSING: ImportError | None = error
    MapTransform = object
else:
    _MISSING = None


class InteriorFeaturesd(MapTransform):
    """Add where inside labelled bodies an image lies, see `igps.inside`, under `KEY_inside` for each key of labels.

    The result depends on the input alone, so that MONAI's caching datasets keep it. `feature_names` names the numbers.

    Args:
        keys: keys of labels (1, X, Y, Z), 0 outside.
        image_key: key of the image (1, X, Y, Z), or several keys.
        labels: the L labels, in the order of the rows of the result.
        allow_missing_keys: leave out keys that are missing, instead of raising a KeyError.

    Returns of a call:
        The dictionary, with arrays (L, numbers) float32 added; a row is NaN if its label has no body of a usable size,
        and a number is NaN if it is not defined.
    """

    def __init__(
        self,
        keys: Hashable | Sequence[Hashable],
        image_key: str | Sequence[str],
        labels: Sequence[int] = (1,),
        allow_missing_keys: bool = False,
    ) -> None:
        if _MISSING is not None:
            raise ImportError(
                'InteriorFeaturesd needs MONAI: pip install "interior-gps[monai]".'
            ) from _MISSING
        super().__init__(keys, allow_missing_keys)
        self.image_keys = (image_key,) if isinstance(image_key, str) else tuple(image_key)
        self.labels = tuple(labels)

    @property
    def feature_names(self) -> list[str]:
        """The names of the numbers, such as `image.core.mean`."""
        return column_names(self.image_keys)

    def __call__(self, data: Mapping[Hashable, Any]) -> dict[Hashable, Any]:
        """Return the dictionary with the numbers of each key added."""
        result = dict(data)
        images = {key: data[key] for key in self.image_keys}
        names = self.feature_names
        for key in self.key_iterator(result):
            row_of = {row["label"]: row for row in inside(images, data[key])}
            rows = []
            for label in self.labels:
                row = row_of.get(str(label), dict.fromkeys(names, np.nan))
                rows.append([row[name] for name in names])
            result[f"{key}_inside"] = np.array(rows, dtype=np.float32)
        return result
