"""Cheap tests of messages before any of them is fused: how large they are, and whether somebody sent them before."""

from robosac.screening.judging import FRAME_PERIOD_S, Bounds, Screened, Screening
from robosac.screening.past import MEMORY, joined, separated

__all__ = ["FRAME_PERIOD_S", "MEMORY", "Bounds", "Screened", "Screening", "joined", "separated"]
