"""A network on sets of samples, compared and combined with histograms of the samples, on held-out families.

    python -m training.studies.set_encoder ROOT

ROOT holds generated shapes (`GradedShapes(...).write(ROOT)`). Each split trains on the classes of half of the families
and scores the classes of the other half. The whitened head of the histograms is fitted to the same classes.
"""

from pathlib import Path
from statistics import mean, stdev

import torch
from jsonargparse import auto_cli
from torch import Tensor, nn
from torch.nn import functional

import igps
from igps.data.batch import SampleBatch, SignatureBatch
from igps.descriptors.pretrained.descriptor import pretrained_parts
from igps.nn.description import describe
from igps.nn.functional import ball_radii, barycentroid_potential, spectral_embedding
from igps.nn.heads.closed_form import WhitenedHead
from igps.retrieval import retrieval_scores
from training.graded import family_of

SCALES = (8, 25, 80)  # eigenpairs of the potential
N_SAMPLES = 256


class SetEncoder(nn.Module):
    """Map samples (N, P, D), in any order, to embeddings (N, 128) of length 1.

    The network is a deep set (Zaheer et al. 2017) with pooling by seeds (Lee et al. 2019).
    """

    def __init__(self, n_features: int, n_seeds: int = 8) -> None:
        super().__init__()
        self.each = nn.Sequential(
            nn.Linear(n_features, 128),
            nn.GELU(),
            nn.Linear(128, 256),
            nn.GELU(),
            nn.Linear(256, 256),
            nn.GELU(),
        )
        self.attention = nn.Linear(256, n_seeds)
        self.whole = nn.Sequential(
            nn.LayerNorm(256 * n_seeds), nn.Dropout(0.2), nn.Linear(256 * n_seeds, 128)
        )

    def forward(self, samples: Tensor) -> Tensor:
        """Return the embeddings of samples."""
        encoded = self.each(samples)
        pooled = self.attention(encoded).softmax(dim=1).transpose(1, 2) @ encoded
        return functional.normalize(self.whole(pooled.flatten(1)), dim=1)


def features(batch: SignatureBatch) -> Tensor:
    """Return features (1, 2P, D) of interior and surface samples: potentials, radii of balls on both sides, kind."""
    surface = batch.surface
    points = surface.points / batch.area.sqrt().float()[:, None, None]
    radii = ball_radii(points, surface.attributes["surface_direction"], surface.mask).log()
    rows = []
    for kind, samples in enumerate((batch.interior, surface)):
        potentials = [potential(samples, batch, n) for n in SCALES]
        own = radii if kind else torch.zeros(*samples.mask.shape, 2)
        columns = torch.cat(
            [torch.stack(potentials, dim=2), own, torch.full_like(own[..., :1], kind)], dim=2
        )
        rows.append(columns[:, torch.linspace(0, columns.shape[1] - 1, N_SAMPLES).long()])
    return torch.cat(rows, dim=1)


def potential(samples: SampleBatch, batch: SignatureBatch, n_eigenpairs: int) -> Tensor:
    """Return the logarithms (1, P) of the potential at samples."""
    embedded = spectral_embedding(
        samples.eigenfunctions, batch.eigenvalues, batch.area, n_eigenpairs=n_eigenpairs
    )
    return barycentroid_potential(embedded).clamp_min(1e-6).log()


def train_encoder(sets: Tensor, labels: Tensor, n_epochs: int, seed: int) -> SetEncoder:
    """Train an encoder by the supervised contrastive loss (Khosla et al. 2020), on batches of 8 shapes of 8 classes."""
    torch.manual_seed(seed)
    encoder = SetEncoder(sets.shape[2])
    optimizer = torch.optim.AdamW(encoder.parameters(), lr=1e-3, weight_decay=0.05)
    n_steps = n_epochs * len(sets) // 64
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 2e-3, total_steps=n_steps)
    for _ in range(n_steps):
        drawn = labels.unique()[torch.randperm(len(labels.unique()))[:8]]
        batch = torch.cat(
            [
                (labels == c).nonzero().flatten()[torch.randperm(int((labels == c).sum()))[:8]]
                for c in drawn
            ]
        )
        subset = torch.randperm(sets.shape[1])[:N_SAMPLES]  # half of the samples
        embedded = encoder(sets[batch][:, subset])
        logits = (embedded @ embedded.T / 0.1).fill_diagonal_(-1e9)
        same = (labels[batch, None] == labels[None, batch]).float().fill_diagonal_(0)
        loss = -((logits.log_softmax(dim=1) * same).sum(dim=1) / same.sum(dim=1)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return encoder.eval()


def study(
    root: Path,
    cache_dir: Path | None = None,
    n_splits: int = 5,
    n_epochs: int = 40,
    first_seed: int = 0,
) -> None:
    """Print FT on classes of held-out families, mean ± standard deviation over splits of the families.

    Args:
        root: folder of generated shapes.
        cache_dir: folder of cached signatures; the user's cache directory if None.
        n_splits: number of splits, with consecutive seeds.
        n_epochs: epochs of training of the encoder.
        first_seed: seed of the first split.
    """
    descriptor = pretrained_parts().eval()
    dataset = igps.SignatureDataset(root, descriptor=descriptor, cache_dir=cache_dir)
    dataset = dataset.usable(dataset.precompute())
    labels, families = dataset.labels, [family_of(name) for name in dataset.classes]
    sets = torch.cat([features(dataset.batch([i])) for i in range(len(dataset))])
    histograms = describe(dataset, descriptor).flatten(1)
    scores: dict[str, list[float]] = {}
    for seed in range(first_seed, first_seed + n_splits):
        order = sorted(set(families))
        chosen = torch.randperm(len(order), generator=torch.Generator().manual_seed(seed))[
            : len(order) // 2
        ].tolist()
        seen = torch.tensor([families[c] in {order[i] for i in chosen} for c in labels.tolist()])
        centre, spread = sets[seen].mean(dim=(0, 1)), sets[seen].std(dim=(0, 1)).clamp_min(1e-6)
        scaled = (sets - centre) / spread
        encoder = train_encoder(scaled[seen], labels[seen], n_epochs, seed)
        head = WhitenedHead().fit(histograms[seen], labels[seen], descriptor.part_cells)
        with torch.no_grad():
            embedded, whitened = encoder(scaled[~seen]), head(histograms[~seen])
        plain = descriptor.distances(histograms[~seen], histograms[~seen])
        by_set, by_head = ((1 - x @ x.T).clamp_min(0) for x in (embedded, whitened))
        both = by_set / by_set.median() + by_head / by_head.median()
        rows = {
            "histograms": plain,
            "whitened": by_head,
            "set encoder": by_set,
            "whitened and set encoder": both,
        }
        for name, distances in rows.items():
            scores.setdefault(name, []).append(
                100 * retrieval_scores(distances, labels[~seen]).mean()["ft"]
            )
        print(seed, {name: round(values[-1], 1) for name, values in scores.items()}, flush=True)
    n_weights = sum(parameter.numel() for parameter in encoder.parameters())
    print(
        f"{len(dataset)} shapes of {len(dataset.classes)} classes, encoder of {n_weights} weights, FT:"
    )
    for name, values in scores.items():
        print(f"{name:<26}{mean(values):>6.1f} ± {stdev(values):.1f}")


if __name__ == "__main__":
    auto_cli(study)
