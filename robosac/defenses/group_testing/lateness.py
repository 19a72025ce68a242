"""Messages that are late: they show every vehicle where it was, moved along with a sender that has moved since.

Nobody is to blame for that. If a message is k times `WHILE_S` late, and comes with the pose of now, it shows a vehicle
``k (c - m)`` from where it is: c is how far the sender moves in that time, m how far the vehicle does. If the sender
turns, all that it shows is turned about it besides. With the pose of then a vehicle is ``-k m`` off. So its own
testimony L tells how late a message is: it is greatest there, and not where the vehicles are. An older message is a
replay.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from robosac.boxes import FloatArray
from robosac.defenses.group_testing.claims import DENIES, SUPPORTS
from robosac.defenses.group_testing.geometry import ACROSS_M, ALONG_M, same_vehicles
from robosac.testimony import Testimony

WHILE_S = 0.2
"""Delays are counted in this, however far apart frames are."""
DELAYS = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 6.0])
"""How late a message may be."""
AGES = np.arange(0.0, 12.5, 0.5)
"""How old one may be that is replayed. In both, the third is `WHILE_S`."""
_A_WHILE = 2
LATEST = 4.0
"""What is later than .8 s is no late message, but a replay."""
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
TURNING = 0.02
"""A sender that turns by less in `WHILE_S`, radians, goes straight on, as far as poses tell."""
SENT_S, SENT_FRAMES, MOST_FRAMES = 5.0, 5, 250
"""How fast a sender is may be told by where it was so long ago: not each sends in every frame. It may be so many frames
ago at least, and at most.
"""
FOLLOWED_S = 1.0
"""So long a vehicle can be followed, be it over one frame or over some that are missing in between."""
FASTEST_M_S = 35.0
"""How fast it may be where it is followed for longer than `WHILE_S`."""
Place = tuple[float, float, float]
"""Where in the world a sender is: x, y, metres, and yaw."""
Sent = tuple[float, float, int, float | None, float]
"""Where in the world a sender was when it last sent a message, x, y, metres; the number of that frame; its yaw, if that
was kept; and how far it had turned in a frame before, radians.
"""


def late(
    testimony: Testimony,
    sender: str,
    moved: FloatArray,
    centres: FloatArray,
    motions: FloatArray,
    turned: float = 0.0,
) -> bool:
    """Whether a sender's message is late, and no replay.

    Parameters
    ----------
    testimony : Testimony
    sender : str
    moved : (2,) ndarray
        How far it moves in `WHILE_S`; ego frame, metres.
    centres, motions : (n, 2) ndarray
        Where vehicles are that others see, and how far each moves in that time.
    turned : float
        How far the sender turns in it, radians.
    """
    return any(delay <= LATEST for delay, _ in _delays(testimony, sender, moved, centres, motions, turned, DELAYS))


def replayed(
    testimony: Testimony,
    sender: str,
    moved: FloatArray,
    centres: FloatArray,
    motions: FloatArray,
    turned: float = 0.0,
) -> bool:
    """Whether a sender's message is older than a late one may be, by most vehicles. Parameters as for `late`."""
    return any(
        age > LATEST and of_most for age, of_most in _delays(testimony, sender, moved, centres, motions, turned, AGES)
    )


def _delays(
    testimony: Testimony,
    sender: str,
    moved: FloatArray,
    centres: FloatArray,
    motions: FloatArray,
    turned: float,
    asked: FloatArray,
) -> Iterator[tuple[float, bool]]:
    """How late a message is of the delays asked for, with the pose of now, of then, and turned, as `_best` has it."""
    said_by, delays = testimony.of({sender}), asked[:, None, None]
    for off in (moved - motions, -motions):
        yield _best(said_by, centres, centres + delays * off, asked)
    if abs(turned) >= TURNING:
        origin = testimony.origins[testimony.agents.index(sender)]
        about = centres - origin + delays * (moved - motions)
        c, s = np.cos(delays * turned), np.sin(delays * turned)
        x, y = about[..., :1], about[..., 1:]
        yield _best(said_by, centres, origin + np.concatenate([c * x - s * y, s * x + c * y], axis=2), asked)


def _best(testimony: Testimony, centres: FloatArray, places: FloatArray, delays: FloatArray) -> tuple[float, bool]:
    """The delay of those (k,) that one sender's testimony fits best if a message so late shows vehicles in ``places``
    (k, n, 2); not a number if it fits none. And whether it supports most of them there: more than three quarters, less
    those that it denies.
    """
    telling = np.hypot(*(places[_A_WHILE] - centres).T) >= MOVED_M
    places = places[:, telling]
    said = testimony.likelihood(places.reshape(-1, 2)).reshape(places.shape[:2])
    sums = said.sum(axis=1)
    best = int(sums.argmax())
    gain = said[best] - said[0]
    better, worse = int((gain >= CLEAR).sum()), int((gain <= -CLEAR).sum())
    enough = bool(sums[best] >= FITS and gain.sum() >= FITS and better >= max(FEWEST, 2 * worse))
    of_most = 4 * int((said[best] >= SUPPORTS).sum() - (said[best] <= DENIES).sum()) > 3 * int(telling.sum())
    return float(delays[best]) if enough else np.nan, of_most


def senders(testimony: Testimony, pose: FloatArray) -> dict[str, Place]:
    """Where in the world each sender is, rounded to 1 cm and 0.1 mrad; ``pose`` is the ego's."""
    placed = (testimony.origins @ pose[:2, :2].T + pose[:2, 3]).round(2).tolist()
    from_ego = testimony.from_ego
    yaws = (np.arctan2(pose[1, 0], pose[0, 0]) - np.arctan2(from_ego[:, 1, 0], from_ego[:, 0, 0])).round(4).tolist()
    return {name: (x, y, yaw) for name, (x, y), yaw in zip(testimony.agents, placed, yaws, strict=True)}


def lately(period_s: float) -> int:
    """In how many frames `SENT_S` are over, within the bounds."""
    return min(MOST_FRAMES, max(SENT_FRAMES, round(SENT_S / period_s)))


def sent(before: Mapping[str, Sent], now: Mapping[str, Place], number: int, most: int) -> dict[str, Sent]:
    """Where senders were that sent a message in a frame of this number, or in one of the ``most`` before the next."""
    recent = {name: last for name, last in before.items() if 0 < number - last[2] < most}
    turned = {name: round(turned_since(before.get(name), place, number, most), 4) for name, place in now.items()}
    return {**recent, **{name: (x, y, number, yaw, turned[name]) for name, (x, y, yaw) in now.items()}}


def moved_since(last: Sent | None, now: Place | None, number: int, most: int) -> FloatArray | None:
    """How far (2,) a sender has moved in a frame, on average since it last sent a message; None if it did not in the
    ``most`` frames before this one, which has that number, or does not in this one.
    """
    if last is None or now is None or not 0 < number - last[2] <= most:
        return None
    moved: FloatArray = np.subtract(now[:2], last[:2]) / (number - last[2])
    return moved


def turned_since(last: Sent | None, now: Place | None, number: int, most: int) -> float:
    """As `moved_since`, how far it has turned, radians; 0 where nothing is known of that."""
    if last is None or now is None or last[3] is None or not 0 < number - last[2] <= most:
        return 0.0
    return float((now[2] - last[3] + np.pi) % (2 * np.pi) - np.pi) / (number - last[2])


def motions(now: FloatArray, before: FloatArray, frames: int = 1, period_s: float = WHILE_S) -> FloatArray:
    """How far (n, 2) each of some boxes (n, 4) has moved in a frame since others were there (m, 4), ``frames`` ago, as
    `geometry.followed` gives them; not a number for what was not there, or too long ago.
    """
    since_s, reach = frames * period_s, (ALONG_M, ACROSS_M)
    if since_s > WHILE_S:
        reach = FASTEST_M_S * since_s, ACROSS_M * since_s / WHILE_S
    if not 0.0 < since_s <= FOLLOWED_S + 1e-9:
        before = before[:0]
    one, other = same_vehicles(now, before, *reach)
    moved = (now[one, :2] - before[other, :2]) / frames
    nearest_last = np.argsort(-np.hypot(*moved.T), kind="stable")
    found = np.full((len(now), 2), np.nan)
    for pair in nearest_last.tolist():
        found[one[pair]] = moved[pair]
    return found
