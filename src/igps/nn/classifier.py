"""A classifier that is trained by gradients, through a descriptor."""

from torch import Tensor, nn

from igps._parameters import check_at_least
from igps.data.batch import SignatureBatch
from igps.nn.descriptor import Descriptor
from igps.retrieval.distances import square_root


class Classifier(nn.Module):
    """The logits of classes, linear in the roots of a descriptor's cells, which are normalised over the batch.

    With `nn.CrossEntropyLoss` and any optimiser it is trained as any network. A descriptor without parameters is as
    fixed as it was; learnable axes and filters are trained along. For labelled folders without a training loop, see
    `igps.fit`.

    Example:
        >>> from igps import descriptor
        >>> sum(parameter.numel() for parameter in Classifier(descriptor("interior"), n_classes=3).parameters())
        1923

    Args:
        descriptor: of histograms, or of other numbers ≥ 0.
        n_classes: of logits.
        dropout: share of cells dropped in training.
    """

    def __init__(self, descriptor: Descriptor, n_classes: int, dropout: float = 0.2) -> None:
        super().__init__()
        check_at_least(2, n_classes=n_classes)
        self.descriptor = descriptor
        n = descriptor.n_features
        # One scale for all cells would leave most of them without weight
        self.layers = nn.Sequential(nn.BatchNorm1d(n, affine=False), nn.Dropout(dropout), nn.Linear(n, n_classes))

    def forward(self, batch: SignatureBatch) -> Tensor:
        """(N, n_classes) logits of N shapes."""
        cells = self.descriptor(batch).flatten(1).to(next(self.layers.parameters()).dtype)
        logits: Tensor = self.layers(square_root(cells))
        return logits
