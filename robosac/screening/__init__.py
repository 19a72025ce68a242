"""Cheap tests of messages before any of them is fused: how large they are, and whether somebody sent them before."""

from robosac.screening.judging import Bounds, Screened, Screening
from robosac.screening.past import MEMORY, joined, separated

__all__ = ["MEMORY", "Bounds", "Screened", "Screening", "joined", "separated"]
