"""Where sensor data comes from: the synthetic intersection."""

from robosac.scenes.intersection import FRAME_PERIOD_S, AgentView, IntersectionScene, SceneFrame
from robosac.scenes.lidar import Lidar

__all__ = ["FRAME_PERIOD_S", "AgentView", "IntersectionScene", "Lidar", "SceneFrame"]
