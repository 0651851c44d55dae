"""A classifier that is trained by gradients, through a descriptor."""

from torch import Tensor, nn

from igps._parameters import check_at_least
from igps.data.batch import SignatureBatch
from igps.nn._kernels.batches import on_one_thread
from igps.nn.descriptor import Descriptor
from igps.retrieval.distances import square_root


class Classifier(nn.Module):
    """A linear classifier on the square roots of a descriptor's cells, with batch normalisation.

    Train it like any network, with `nn.CrossEntropyLoss` and an optimiser. Learnable axes and filters of the descriptor
    are trained as well; a descriptor without parameters stays fixed. To classify labelled folders without a training
    loop, see `igps.fit`.

    Example:
        >>> from igps import descriptor
        >>> sum(parameter.numel() for parameter in Classifier(descriptor("interior"), n_classes=3).parameters())
        1923

    Args:
        descriptor: its descriptions are histograms, or other numbers ≥ 0.
        n_classes: number of logits.
        dropout: share of cells dropped in training.
    """

    def __init__(self, descriptor: Descriptor, n_classes: int, dropout: float = 0.2) -> None:
        super().__init__()
        check_at_least(2, n_classes=n_classes)
        self.descriptor = descriptor
        n = descriptor.n_features
        # Each cell is normalised separately: with a common scale, most cells would have no influence.
        self.layers = nn.Sequential(
            nn.BatchNorm1d(n, affine=False), nn.Dropout(dropout), nn.Linear(n, n_classes)
        )

    def forward(self, batch: SignatureBatch) -> Tensor:
        """Return the logits (N, n_classes) of N shapes; like their gradients, on one thread."""
        return on_one_thread(self._logits, batch, self)

    def _logits(self, batch: SignatureBatch) -> Tensor:
        dtype = next(self.layers.parameters()).dtype
        cells = self.descriptor(batch).flatten(1).to(dtype)
        logits: Tensor = self.layers(square_root(cells))
        return logits
