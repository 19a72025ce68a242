"""What is remembered of the messages that a vehicle sent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

MEMORY = "screening"
"""Under which a session's state holds what was sent."""
KEPT_FRAMES = 5
"""What was sent is remembered for so many frames; where numbers begin anew, what is as many ahead is forgotten, too."""
Place = tuple[float, float]
"""x and y in the world, metres, rounded to 1 cm."""


class Sent(NamedTuple):
    """A message that was sent, perhaps several times."""

    digest: str
    first: int
    last: int
    """Frames."""
    place: Place
    """Where it was sent from first."""


class Anchor(NamedTuple):
    """A map to compare later ones with."""

    frame: int
    place: Place
    text: str
    """Its sketch, `packed`."""


@dataclass(frozen=True)
class Past:
    """What is remembered of one vehicle."""

    sent: tuple[Sent, ...] = ()
    anchor: Anchor | None = None
    refused: int = 0
    """Messages that were refused, and count for its being named."""
    differs: float | None = None
    """Of the ego: 1 less the correlation of its latest two maps from different places; None before there are such."""

    @classmethod
    def from_json(cls, fields: Mapping[str, Any] | None) -> Past:
        """What `as_json` gave; nothing of a vehicle that is new."""
        if fields is None:
            return cls()
        sent = tuple(Sent(digest, first, last, (x, y)) for digest, first, last, x, y in fields["sent"])
        frame, x, y, sketch = fields["anchor"]
        return cls(sent, Anchor(frame, (x, y), sketch), int(fields.get("refused", 0)), fields.get("differs"))

    def as_json(self) -> dict[str, Any]:
        """JSON values; there must be an anchor."""
        assert self.anchor is not None
        return {
            "sent": [[each.digest, each.first, each.last, *each.place] for each in self.sent],
            "anchor": [self.anchor.frame, *self.anchor.place, self.anchor.text],
            **({"refused": self.refused} if self.refused else {}),
            **({} if self.differs is None else {"differs": self.differs}),
        }


def is_kept(then: int, frame: int) -> bool:
    """Whether what was sent in a frame is still remembered in another."""
    return abs(frame - then) < KEPT_FRAMES


def recent(past: Mapping[str, Any], frame: int) -> bool:
    """Whether a vehicle that is not in this frame has sent something lately; ``past`` is as JSON."""
    last: int = max((entry[2] for entry in past["sent"]), default=past["anchor"][0])
    return is_kept(last, frame)


def separated(state: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """A session's state as the defence's alone, and what the tests of messages remember."""
    alone = dict(state)
    memory = alone.pop(MEMORY, None)
    return alone, dict(memory) if isinstance(memory, Mapping) else {}


def joined(state: Mapping[str, Any], memory: Mapping[str, Any]) -> dict[str, Any]:
    """The state of both; the defence's alone where nothing is remembered."""
    return {**state, MEMORY: dict(memory)} if memory else dict(state)
