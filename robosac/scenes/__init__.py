"""Where scenes come from: the synthetic intersection, V2X-Sim samples, or the user's own data."""

from robosac.plugins import Kind
from robosac.scenes.base import (
    Frame,
    Scene,
    SceneError,
    SceneSource,
    Split,
    View,
    encoded,
    first_scenes,
    one_scene,
    seconds_apart,
    whose_turn,
)
from robosac.scenes.checked import CheckedSource
from robosac.scenes.intersection import FRAME_PERIOD_S, AgentView, IntersectionScene, SceneFrame
from robosac.scenes.lidar import Lidar
from robosac.scenes.worlds import WORLDS, World

DEFAULT_DATA = "synthetic"
DATA_HELP = "Where scenes come from: synthetic, world:NAME, v2x-sim:DIR, recording:FILE, or module:callable."
SOURCES: Kind[SceneSource] = Kind(
    noun="scene source",
    package="robosac.scenes",
    contract=SceneSource,
    name_of=lambda candidate: vars(candidate).get("kind", ""),
    takes_argument=True,
    forms="world:NAME, v2x-sim:DIR, recording:FILE, or module:callable",
    error=SceneError,
)
"""All sources by name; `Kind.make` makes one."""


def load_source(text: str) -> SceneSource:
    """The source that ``--data`` asks for; the frames of one that does not ship are checked as they are read.

    Raises
    ------
    SceneError
        If there is no such source, or it is none.
    """
    made = SOURCES.make(text)
    return made if type(made) in SOURCES.shipped.values() else CheckedSource(made)


__all__ = [
    "DATA_HELP",
    "DEFAULT_DATA",
    "FRAME_PERIOD_S",
    "AgentView",
    "Frame",
    "IntersectionScene",
    "Lidar",
    "Scene",
    "SceneError",
    "SceneFrame",
    "SceneSource",
    "SOURCES",
    "Split",
    "View",
    "WORLDS",
    "World",
    "encoded",
    "first_scenes",
    "load_source",
    "one_scene",
    "seconds_apart",
    "whose_turn",
]
