"""Scenes with three teammates, as all subsets of them are soon recorded."""

from dataclasses import replace

from robosac.scenes.intersection import Synthetic


class Few(Synthetic):
    kind = name = "few"

    def scenes(self, split):
        return [replace(scene, car_agents=3) for scene in super().scenes(split)]
