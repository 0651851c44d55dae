"""The systems that the paper compares with or builds on, each in one file, and their comparison."""

from igps.baselines.canonical_form import CanonicalForm
from igps.baselines.comparison import Result, compare
from igps.baselines.d2 import D2
from igps.baselines.geodesic_spectral import GeodesicSpectral
from igps.baselines.gps import GPS
from igps.baselines.inner_distance import InnerDistance
from igps.baselines.interior import Interior
from igps.baselines.local_diameter_centricity import LocalDiameterCentricity
from igps.baselines.shape_dna import ShapeDNA
from igps.baselines.spectral_gw import SpectralGromovWasserstein
from igps.baselines.system import Body, System
from igps.baselines.volume_shape_dna import VolumeShapeDNA

__all__ = ["Body", "Result", "System", "compare", "systems"]


def systems() -> dict[str, System]:
    """All systems by name, with the parameters of their sources."""
    every: tuple[System, ...] = (
        Interior(),
        GPS(),
        D2(),
        ShapeDNA(),
        VolumeShapeDNA(),
        LocalDiameterCentricity(),
        InnerDistance(),
        CanonicalForm(),
        GeodesicSpectral(),
        SpectralGromovWasserstein(),
    )
    return {system.name: system for system in every}
