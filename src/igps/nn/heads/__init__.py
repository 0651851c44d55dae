"""Heads: modules that map descriptions to embeddings, fitted in closed form or trained on labels."""

from igps.nn.heads.base import Head
from igps.nn.heads.classifier import ClassifierHead, ClassifyingHead
from igps.nn.heads.closed_form import KernelHead, WhitenedHead
from igps.nn.heads.learned import BlendedDistance, ProjectionHead
from igps.nn.heads.linear import LinearHead
from igps.nn.heads.two_level import TwoLevelHead
from igps.nn.heads.wccn import WCCNHead

__all__ = [
    "BlendedDistance",
    "ClassifierHead",
    "ClassifyingHead",
    "Head",
    "KernelHead",
    "LinearHead",
    "ProjectionHead",
    "TwoLevelHead",
    "WCCNHead",
    "WhitenedHead",
]
