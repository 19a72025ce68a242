"""Where sensor data comes from: the synthetic intersection."""

from robosac.scenes.intersection import FRAME_PERIOD_S, FRAMES_PER_SECOND, AgentView, IntersectionScene, SceneFrame
from robosac.scenes.lidar import Lidar

__all__ = ["FRAMES_PER_SECOND", "FRAME_PERIOD_S", "AgentView", "IntersectionScene", "Lidar", "SceneFrame"]
