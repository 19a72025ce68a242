"""Scenes with three teammates, as all subsets of them are soon recorded."""

from dataclasses import replace
from types import SimpleNamespace

from robosac.scenes.intersection import Synthetic


class Few(Synthetic):
    kind = name = "few"

    def scenes(self, split):
        return [replace(scene, car_agents=3) for scene in super().scenes(split)]


class Numbered(Few):
    """Its agents have no ids."""

    def scenes(self, split):
        return [SimpleNamespace(number=0, length=None, frame_period_s=0.2, agents=(1, 2), egos=(1,))]
