"""Heads: modules that map descriptions to embeddings, fitted in closed form or trained on labels."""

from igps.nn.heads.base import Head
from igps.nn.heads.classifier import ClassifierHead
from igps.nn.heads.closed_form import KernelHead, WhitenedHead
from igps.nn.heads.learned import BlendedDistance, ProjectionHead
from igps.nn.heads.two_level import TwoLevelHead
from igps.nn.heads.wccn import WCCNHead

__all__ = [
    "BlendedDistance",
    "ClassifierHead",
    "Head",
    "KernelHead",
    "ProjectionHead",
    "TwoLevelHead",
    "WCCNHead",
    "WhitenedHead",
]
