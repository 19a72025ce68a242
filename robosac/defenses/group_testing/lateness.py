"""Messages that are late: they show every vehicle where it was, moved along with a sender that has moved since.

Nobody is to blame for that. If a message is k times `WHILE_S` late, and comes with the pose of now, it shows a vehicle
``k (c - m)`` from where it is: c is how far the sender moves in that time, m how far the vehicle does. With the pose of
then that is ``-k m``. So its own testimony L tells how late a message is: it is greatest there, and
not where the vehicles are. An older message is a replay.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from robosac.boxes import FloatArray
from robosac.defenses.group_testing.geometry import same_vehicles
from robosac.testimony import Testimony

WHILE_S = 0.2
"""Delays are counted in this, however far apart frames are."""
DELAYS = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0])
"""How late a message may be."""
LATEST = 2.5
"""What is later than half a second is no late message, but a replay."""
MOVED_M = 1.0
"""Vehicles tell how late a message is that it would show so far off if it were `WHILE_S` late."""
FITS = 6.0
"""L of a late message, summed over vehicles, is at least so much where it shows them, and greater by as much than where
they are.
"""
CLEAR, FEWEST = 1.0, 2
"""At least so many vehicles fit better, by so much L, and twice as many as fit worse: a lie about one or two does not
excuse itself.
"""
SENT_FRAMES = 5
"""How fast a sender is may be told by where it was so many frames ago: not each sends in every frame."""
Place = tuple[float, float]
Sent = tuple[float, float, int]
"""Where in the world a sender was when it last sent a message, x, y, metres; and the number of that frame."""


def late(testimony: Testimony, sender: str, moved: FloatArray, centres: FloatArray, motions: FloatArray) -> bool:
    """Whether a sender's message is late.

    Parameters
    ----------
    testimony : Testimony
    sender : str
    moved : (2,) ndarray
        How far it moves in `WHILE_S`; ego frame, metres.
    centres, motions : (n, 2) ndarray
        Where vehicles are that others see, and how far each moves in that time.
    """
    said_by = testimony.of({sender})
    return any(_fits(said_by, centres, off) for off in (moved - motions, -motions))


def _fits(testimony: Testimony, centres: FloatArray, off: FloatArray) -> bool:
    """Whether one sender's testimony fits a late message best. `WHILE_S` late it would show each vehicle so far ``off``
    (n, 2) from where it is.
    """
    telling = np.hypot(*off.T) >= MOVED_M
    places = centres[telling] + DELAYS[:, None, None] * off[telling]
    said = testimony.likelihood(places.reshape(-1, 2)).reshape(places.shape[:2])
    sums = said.sum(axis=1)
    best = int(sums.argmax())
    gain = said[best] - said[0]
    better, worse = int((gain >= CLEAR).sum()), int((gain <= -CLEAR).sum())
    enough = bool(sums[best] >= FITS and gain.sum() >= FITS and better >= max(FEWEST, 2 * worse))
    return enough and bool(DELAYS[best] <= LATEST)


def senders(testimony: Testimony, pose: FloatArray) -> dict[str, Place]:
    """Where in the world each sender is, metres, rounded to 1 cm; ``pose`` is the ego's."""
    placed = (testimony.origins @ pose[:2, :2].T + pose[:2, 3]).round(2)
    return {name: (x, y) for name, (x, y) in zip(testimony.agents, placed.tolist(), strict=True)}


def sent(before: Mapping[str, Sent], now: Mapping[str, Place], number: int) -> dict[str, Sent]:
    """Where senders were that sent a message in a frame of this number, or lately."""
    lately = {name: last for name, last in before.items() if 0 < number - last[2] < SENT_FRAMES}
    return {**lately, **{name: (x, y, number) for name, (x, y) in now.items()}}


def moved_since(last: Sent | None, now: Place | None, number: int) -> FloatArray | None:
    """How far (2,) a sender has moved in a frame, on average since it last sent a message; None if it did not lately,
    or does not in this frame, which has that number.
    """
    if last is None or now is None or not 0 < number - last[2] <= SENT_FRAMES:
        return None
    moved: FloatArray = np.subtract(now, last[:2]) / (number - last[2])
    return moved


def motions(now: FloatArray, before: FloatArray) -> FloatArray:
    """How far (n, 2) each of some boxes (n, 4) has moved since the frame before, in which there were others (m, 4), as
    `geometry.followed` gives them; not a number for what was not there.
    """
    one, other = same_vehicles(now, before)
    moved = now[one, :2] - before[other, :2]
    nearest_last = np.argsort(-np.hypot(*moved.T), kind="stable")
    found = np.full((len(now), 2), np.nan)
    for pair in nearest_last.tolist():
        found[one[pair]] = moved[pair]
    return found
