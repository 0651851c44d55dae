"""The systems that the paper compares with or builds on, each in one file, and their comparison."""

from collections.abc import Sequence

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


def systems(names: Sequence[str] | None = None) -> dict[str, System]:
    """Systems by name, with the parameters of their sources; all of them if no names are given.

    Raises:
        ValueError: an unknown name.
    """
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
    known = {system.name: system for system in every}
    if unknown := [name for name in names or () if name not in known]:
        raise ValueError(f"descriptors: no system is called {unknown[0]}. There are {', '.join(known)}.")
    return {name: known[name] for name in names or known}
