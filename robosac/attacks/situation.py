"""What an adversary knows besides messages: where everybody is, what was before, and what it lies about."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
import torch

from robosac.attacks.hearing import Hearing
from robosac.boxes import FloatArray, from_world, to_world
from robosac.detectors.base import Message

LieKind = Literal["ghost", "erased", "dimmed", "moved", "reshaped"]
"""An object that does not exist; one that exists and should not be seen; one that should be seen too faintly to count;
one that should be seen elsewhere; and one that should be seen with another heading or size.
"""
Foreign = Callable[[str, int], Message | None]
"""Of an agent and the number of a frame, what it senses in another scene; None if nothing."""
KEPT_S = 2.0
"""So many seconds of benign messages an adversary keeps."""


@dataclass(frozen=True, eq=False)
class Lie:
    """What an attack on an object says about it in one frame.

    Raises
    ------
    ValueError
        If there is no such kind, the number is no integer, or a box is not five finite numbers, or has no size.
    """

    kind: LieKind
    box: FloatArray
    """(5,), ego frame: where the ghost stands, where the erased or dimmed vehicle is, or how the moved or reshaped one
    should be seen.
    """
    number: int = 0
    """Which of the attack's objects this is; the same one has the same number from frame to frame."""
    truth: FloatArray | None = None
    """(5,), ego frame: how a moved or reshaped vehicle really is."""

    def __post_init__(self) -> None:
        if self.kind not in get_args(LieKind):
            raise ValueError(f"no lie is of kind {self.kind!r}; the kinds are {', '.join(get_args(LieKind))}")
        if not isinstance(self.number, int | np.integer):
            raise ValueError(f"the number of a lie must be an integer, got {self.number!r:.100}")
        for name, box in (("box", self.box), ("truth", self.truth)):
            if box is not None or name == "box":
                _check_box(f"{name} of a lie", box)


def _check_box(what: str, box: object) -> None:
    wanted = f"{what} must be x, y, length, width, yaw, an array of shape (5,)"
    if not isinstance(box, np.ndarray) or box.dtype.kind not in "fiu":
        raise ValueError(f"{wanted}, got {box!r:.100}")
    if box.shape != (5,):
        raise ValueError(f"{wanted}, got one of shape {box.shape}")
    if not np.isfinite(box).all() or min(box[2:4]) <= 0:
        raise ValueError(f"{wanted}, finite, length and width positive, got {box.tolist()}")


@dataclass(frozen=True, eq=False)
class Situation:
    """What an adversary knows of a frame besides its messages, and what it says about it.

    An attack reads all and writes two parts: its `memory`, and its `lies` if it has any.
    """

    frame: int = 0
    """Its number in the sequence."""
    period_s: float = 0.2
    """Time from one frame to the next, seconds."""
    ego_pose: FloatArray = field(default_factory=lambda: np.eye(4))
    """(4, 4): world_from_sensor."""
    poses: Mapping[str, FloatArray] = field(default_factory=dict)
    """By teammate: the pose in its message, world_from_sensor (4, 4)."""
    truth: FloatArray = field(default_factory=lambda: np.empty((0, 5)))
    """(V, 5): true boxes of all other vehicles around the ego, seen or not, as far as the scene tells; ego frame."""
    earlier: Mapping[int, Mapping[str, Message]] = field(default_factory=dict)
    """By number: everybody's benign messages of the last frames, `KEPT_S` seconds of them."""
    memory: dict[str, Any] = field(default_factory=dict)
    """The attack's own. It lasts for one sequence of one ego."""
    foreign: Foreign | None = None
    """Gives messages of another scene; None where there is none."""
    tensor: Callable[[Message], torch.Tensor] | None = None
    """Turns a message into what an attack surface shows of it; None where no detector is at hand."""
    hearing: Hearing | None = None
    """What each message says by itself; None unless the attack asks for it (`robosac.attacks.Attack.hears`), or where
    the detector has no witness.
    """
    lies: list[Lie] = field(default_factory=list)
    """What the attack says that it lies about in this frame."""
    _known: dict[Hashable, Any] = field(default_factory=dict)

    def in_world(self, boxes: FloatArray) -> FloatArray:
        """Boxes (n, 5+) of the ego's frame in the world frame."""
        return to_world(boxes, self.ego_pose)

    def around_ego(self, boxes: FloatArray) -> FloatArray:
        """Boxes (n, 5+) of the world frame in the ego's frame."""
        return from_world(boxes, self.ego_pose)

    def once(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """What ``make`` returns; it is called once in this frame for each key. Not part of `memory`."""
        if key not in self._known:
            self._known[key] = make()
        return self._known[key]


@dataclass
class Past:
    """What an adversary has of one sequence of one ego, from frame to frame."""

    period_s: float = 0.2
    foreign: Foreign | None = None
    memory: dict[str, Any] = field(default_factory=dict)
    earlier: dict[int, Mapping[str, Message]] = field(default_factory=dict)
    """As in a `Situation`, all four."""

    def situation(self, frame: int, ego: Message, benign: Mapping[str, Message], truth: FloatArray) -> Situation:
        """The next frame: its number, the ego's message, the teammates' benign ones, and the true boxes (V, 5)."""
        poses = {name: message.pose for name, message in benign.items()}
        return Situation(
            frame, self.period_s, ego.pose, poses, truth, dict(self.earlier), self.memory, foreign=self.foreign
        )

    def keep(self, frame: int, benign: Mapping[str, Message]) -> None:
        """Keep a frame's benign messages, and forget those that are too old."""
        self.earlier[frame] = benign
        for number in [n for n in self.earlier if (frame - n) * self.period_s > KEPT_S + 1e-9]:
            del self.earlier[number]
