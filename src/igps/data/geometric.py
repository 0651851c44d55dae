"""Conversion of Signatures for PyTorch Geometric."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from igps.data.batch import LabelledSignature
from igps.signature.signature import SampleKind, Signature

if TYPE_CHECKING:
    from torch_geometric.data import Data


def to_pyg(
    body: LabelledSignature | Signature, samples: SampleKind = "surface", label: int = -1
) -> Data:
    """Convert the samples of a body to `torch_geometric.data.Data` with P nodes and no edges.

    The tensors are copies, so transforms may change them in place. Lists of such bodies are what PyTorch Geometric's
    loader takes: `DataLoader([to_pyg(item) for item in dataset], batch_size=4)`.

    Args:
        body: an item of a dataset, with its label, or a Signature.
        samples: "interior" or "surface".
        label: of a Signature.

    Returns:
        `pos` (P, 3); `eigenfunctions` (P, K); `mass` (P,), the share of each sample in the area of the surface or in
        the volume; the attributes of the samples under their names; `eigenvalues` (1, K), `area` and `volume` (1,),
        which are batched by body; `y` (1,), the label.

    Raises:
        ImportError: PyTorch Geometric is not installed.
    """
    try:
        from torch_geometric.data import Data
    except ImportError as error:
        raise ImportError(
            'to_pyg: needs PyTorch Geometric: pip install "interior-gps[geometric]".'
        ) from error
    if isinstance(body, LabelledSignature):
        signature = body.signature
        label = body.label
    else:
        signature = body
    chosen = getattr(signature, samples)
    measure = signature.area if samples == "surface" else signature.volume
    return Data(
        pos=torch.tensor(chosen.points, dtype=torch.float32),
        eigenfunctions=torch.tensor(chosen.eigenfunctions),
        mass=torch.full((len(chosen),), measure / len(chosen)),
        eigenvalues=torch.from_numpy(signature.eigenvalues).float()[None],
        area=torch.tensor([signature.area]),
        volume=torch.tensor([signature.volume]),
        y=torch.tensor([label]),
        **{name: torch.tensor(values) for name, values in chosen.attributes.items()},
    )
