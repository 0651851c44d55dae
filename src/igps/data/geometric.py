"""Signatures for PyTorch Geometric."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from igps.signature.signature import SampleKind, Signature

if TYPE_CHECKING:
    from torch_geometric.data import Data


def to_pyg(signature: Signature, samples: SampleKind = "surface", label: int = -1) -> Data:
    """The samples of a body as `torch_geometric.data.Data`: P nodes without edges, which its loaders batch.

    They are copies, which transforms may change in place.

    Returns:
        `pos` (P, 3); `eigenfunctions` (P, K); `mass` (P,), the share of the surface's area, or of the volume, of each
        sample; the attributes of the samples under their names; `eigenvalues` (1, K), `area` and `volume` (1,), which
        are batched by body; `y` (1,).

    Raises:
        ImportError: PyTorch Geometric is not installed.
    """
    try:
        from torch_geometric.data import Data
    except ImportError as error:
        raise ImportError('to_pyg: needs PyTorch Geometric: pip install "interior-gps[geometric]".') from error
    found = getattr(signature, samples)
    measure = signature.area if samples == "surface" else signature.volume
    return Data(
        pos=torch.tensor(found.points, dtype=torch.float32),
        eigenfunctions=torch.tensor(found.eigenfunctions),
        mass=torch.full((len(found),), measure / len(found)),
        eigenvalues=torch.from_numpy(signature.eigenvalues).float()[None],
        area=torch.tensor([signature.area]),
        volume=torch.tensor([signature.volume]),
        y=torch.tensor([label]),
        **{name: torch.tensor(values) for name, values in found.attributes.items()},
    )
