"""Fusions in which one place differs, and what is said of it."""

import numpy as np

from robosac.defenses.group_testing.hearing import Hearing
from tests.robosac.testifying import saying

PLACE = np.array([10.4, 4.3])
ELSEWHERE = np.array([-12.4, -7.3])
YES, NO = 5.5, -7.0
TEAM = ("a", "b", "c", "d")


def car(place=PLACE, score=0.85, off=(0.0, 0.0), yaw=0.0):
    """A box whose centre is off its place along and across itself, metres."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    x, y = place + [off[0] * cos - off[1] * sin, off[0] * sin + off[1] * cos]
    return np.array([[x, y, 4.5, 1.9, yaw, score]])


REST = car(ELSEWHERE)
NOTHING = np.zeros((0, 6))


def hearing(unheard=(), place=PLACE, **said):
    """What the ego and teammates say of a place; somewhere else the ego and "a" see a car."""
    words = {"": said.pop("ego", 0.0), **{name: said.get(name, 0.0) for name in TEAM}}
    known = {name: [(*place, value)] for name, value in words.items()}
    for name in ("", "a"):
        known[name].append((*ELSEWHERE, YES))
    return Hearing(saying(known), unheard)


DENIED = {"ego": -2.0, "b": NO, "c": NO, "d": YES}
SEEN = {"b": YES, "c": YES}
