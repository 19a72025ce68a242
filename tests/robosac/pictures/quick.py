"""An attack that does enough in few steps."""

from robosac.attacks import PGD


def attack():
    return PGD(steps=3, step_size=0.3)
