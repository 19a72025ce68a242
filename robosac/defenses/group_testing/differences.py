"""What one decoded fusion does to single objects beside another one: who is to blame for what is wrong.

What is wrong with an object in a fusion is blamed on a teammate only if it is not so in the same fusion without it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import compress

import numpy as np

from robosac.boxes import BoolArray, FloatArray, IntArray, pairwise_iou
from robosac.defenses.group_testing.claims import DENIES, SUPPORTS, WEIGHTY, two_witnesses
from robosac.defenses.group_testing.hearing import CERTAIN, OWN_M
from robosac.defenses.group_testing.objects import AWAY, CRISP_SCORE, PLACED_SCORE, SHOWN_SCORE, Lie, Shown

CRISP_ODDS = float(np.log(CRISP_SCORE / (1 - CRISP_SCORE)))
"""Logarithm of the odds of a box of that score."""
OWN_DENIES = -4.0
"""Whose own message denies a place so far is not to blame for a box there."""
GONE_EFFECT = 1.5
"""A box is gone by somebody's fault if it had such a score, and has so much less now: faint ones come and go."""
FEWEST_ALONE = 3
"""Of fusions of fewer teammates one witness alone does not tell that something is gone."""
EFFECT = 1.0
"""Logarithm of the odds of a box by which it has to grow or shrink."""
AWAY_EFFECT = 0.5
MOST_AWAY = 2.0
"""What a single box counts, at most, of how far fusions misplace boxes."""
ADRIFT = 1.0
"""Boxes misplaced by so much are moved by whoever joins."""
SAME_BOX_M = 1.5
"""Boxes of two fusions that are centred so near each other show the same vehicle."""
SAME_LIE_M = 3.0
"""Lies so near each other are about one object."""
SHOWN_IOU = 0.3
"""A box shows a vehicle from this IoU on. A vehicle half of its length ahead of itself is lost where it is."""
CARRIED_M = (1.0, 4.0)
"""A vehicle is carried off by so much."""


def effects(joined: Shown, without: Shown, suspects: Sequence[str]) -> list[Lie]:
    """What is wrong in a fusion, and is not in the same fusion without the suspects.

    - ``ghost``: a contradicted box whose odds without them are less by a factor of e; veiled, if their own messages
      deny it, or nobody supports it;
    - ``gone``: a box without them where the others support a vehicle, and with them no box shows it (`gone`);
    - ``moved``: a box that is out of place, and without them less so. If it is so along itself only, it may be late. So
      it may if many boxes together are `misplaced`, each a little. Or a box that they have `carried` off.
    """
    contradicted = joined.claims.contradicted_by_others(suspects)
    ghosts = (contradicted | joined.on_nobodys_word) & (joined.boxes[:, 5] >= CRISP_SCORE)
    grown, own = joined.boxes[ghosts], joined.own(suspects)[:, ghosts].max(axis=0)
    drop = joined.odds_at(grown[:, :2]) - without.odds_at(grown[:, :2])
    veiled = (own <= OWN_DENIES) | ~contradicted[ghosts]
    found = [Lie("ghost", grown[i, :2], bool(veiled[i])) for i in np.flatnonzero(drop >= EFFECT)]
    found += _taken(joined, without, suspects)
    found += [Lie("gone", without.boxes[i, :2], alone=True) for i in gone_alone(joined, without, suspects)]
    away, aside, other = joined.away(suspects), joined.away(suspects, across=True), without.away(suspects)
    farther: dict[int, int] = dict(joined.beside(without, _farther).T.tolist())
    for index in np.flatnonzero((away >= AWAY) & (joined.boxes[:, 5] >= PLACED_SCORE) & ~ghosts).tolist():
        same = _at(without, joined.boxes[index])
        same = farther.get(index) if same is None else same
        if same is not None and 0.0 < other[same] <= away[index] - AWAY_EFFECT:
            by, along = joined.accusers(index, suspects), bool(aside[index] < AWAY)
            found.append(Lie("moved", joined.boxes[index, :2], along=along, by=by))
    for index, at in carried(joined, without, suspects).T.tolist():
        both = joined.boxes[index, :2], without.boxes[at, :2]
        if all(np.hypot(*(lie.place - place)) > SAME_LIE_M for lie in found for place in both):
            by = _speaking_for(joined, index, without, at, suspects)
            found.append(Lie("moved", joined.boxes[index, :2], by=by))
    if all(lie.kind != "moved" for lie in found) and misplaced(joined, without, suspects) >= ADRIFT:
        places, grown = _grown(joined, without, suspects)
        found.append(Lie("moved", places[grown.argmax()], along=True))
    return found


def _taken(joined: Shown, without: Shown, suspects: Sequence[str]) -> list[Lie]:
    """Lies of the kind ``gone``."""
    which = gone(joined, without, suspects)
    lost = without.boxes[which]
    drop = without.odds_at(lost[:, :2]) - joined.odds_at(lost[:, :2])
    which = which[(lost[:, 5] >= CRISP_SCORE) & (drop >= GONE_EFFECT)]
    own = without.own(suspects)[:, which].min(axis=0).tolist()
    supporting = zip(without.claims.witnesses, without.claims.supporting, strict=True)
    others = [(name, sees) for name, sees in supporting if name not in suspects]
    return [
        Lie(
            "gone",
            without.boxes[at, :2],
            veiled=said >= SUPPORTS,
            said=said <= DENIES,
            by=tuple(name for name, sees in others if sees[at]),
        )
        for at, said in zip(which.tolist(), own, strict=True)
    ]


def blame(found: Mapping[str, Sequence[Lie]], joined: Shown) -> dict[str, list[Lie]]:
    """Who is to blame for what is wrong in a fusion, of what is not so without each suspect.

    What is explained by several may be the doing of one of them, who makes it show only beside another. Then those are
    to blame whose own message goes with the lie, and if nobody's does, nobody is.
    """
    blamed: dict[str, list[Lie]] = {name: [] for name in found}
    for name, lies in found.items():
        for lie in lies:
            others = [
                other
                for other, theirs in found.items()
                if other != name and any(np.hypot(*(each.place - lie.place)) <= SAME_LIE_M for each in theirs)
            ]
            if not others or joined.goes_with(name, lie):
                blamed[name].append(lie)
    return blamed


def persists(lie: Lie, part: Shown, without: Shown) -> bool:
    """Whether what is wrong in a fusion, and is not ``without`` a suspect, is so in a part of it, too, in which the
    suspect is fused: a ghost is crisp there, and what is moved is nearer to where the lie has it than by half.
    """
    if lie.kind == "moved":
        nearest = [_nearest(shown, lie.place) for shown in (part, without)]
        return nearest[0] <= SAME_BOX_M and nearest[0] <= nearest[1] / 2
    here, there = (float(shown.odds_at(lie.place[None])[0]) for shown in (part, without))
    if lie.kind == "ghost":
        return here >= CRISP_ODDS and here - there >= EFFECT
    return there - here >= GONE_EFFECT


def _nearest(shown: Shown, place: FloatArray) -> float:
    boxes = shown.boxes[shown.boxes[:, 5] >= PLACED_SCORE, :2]
    return float(np.hypot(*(boxes - place).T).min(initial=np.inf))


def misplaced(joined: Shown, without: Shown, joining: Collection[str]) -> float:
    """How much farther boxes are from where others see the vehicles than they are without those who join.

    The sum over boxes of what `Shown.away` grows by, at most `MOST_AWAY` each, by the square root of their number: for
    honest messages about normal around 0. Boxes of score >= .4 count that two others see, in both fusions.
    """
    _, grown = _grown(joined, without, joining)
    return float(grown.sum() / np.sqrt(max(len(grown), 1)))


def _grown(joined: Shown, without: Shown, joining: Collection[str]) -> tuple[FloatArray, FloatArray]:
    """Centres (k, 2) of boxes of a fusion that are in the other one, too, and how much farther (k,) each is from where
    others see the vehicle.
    """
    now, before = joined.away(joining), without.away(joining)
    placed = (joined.boxes[:, 5] >= PLACED_SCORE) & (now > 0.0)
    known = (without.boxes[:, 5] >= PLACED_SCORE) & (before > 0.0)
    here, there = same_boxes(joined, without, placed, known)
    most = 2 * MOST_AWAY
    grown = np.minimum(now[here], most) - np.minimum(before[there], most)
    return joined.boxes[here, :2], np.clip(grown, -MOST_AWAY, MOST_AWAY)


def same_boxes(joined: Shown, without: Shown, placed: BoolArray, known: BoolArray) -> tuple[IntArray, IntArray]:
    """Boxes of a fusion, of those (n,) that are ``placed``, for which another one shows the same vehicle: their places
    there, and those of the nearest ones here, of those (m,) that are ``known``; (k,) each.
    """
    now, before = np.flatnonzero(placed), np.flatnonzero(known)
    if not len(now) or not len(before):
        return now[:0], before[:0]
    x, y = (joined.boxes[now, None, axis] - without.boxes[before, axis] for axis in (0, 1))
    apart = np.hypot(x, y)
    near = apart.min(axis=1) <= SAME_BOX_M
    return now[near], before[apart.argmin(axis=1)[near]]


def carried(joined: Shown, without: Shown, suspects: Collection[str]) -> IntArray:
    """Boxes of two fusions, by their places in each (2, k), that show one vehicle 1 to 4 m apart, and others than the
    suspects say that it stands where the second one has it.

    The ego or two others support the second; the sum of their L is greater by 6 there. A witness that is asked of a
    place beside a vehicle sees it nearer to that place than it is, so `Shown.away` does not always tell.
    """
    found = joined.beside(without, _farther)
    others = np.array([name not in suspects for name in joined.claims.witnesses])
    there, here = (shown.claims.likelihood[others][:, at] for shown, at in zip((joined, without), found, strict=True))
    return found[:, two_witnesses(here >= SUPPORTS) & (here.sum(axis=0) - there.sum(axis=0) >= WEIGHTY)]


def _farther(joined: Shown, without: Shown) -> IntArray:
    """Boxes of two fusions, by their places in each (2, k), score >= .4, of which each is the nearest one to the other,
    1 to 4 m away.
    """
    now = np.flatnonzero(joined.boxes[:, 5] >= PLACED_SCORE)
    before = np.flatnonzero(without.boxes[:, 5] >= PLACED_SCORE)
    if not len(now) or not len(before):
        return np.zeros((2, 0), dtype=np.int64)
    x, y = (without.boxes[before, None, axis] - joined.boxes[now, axis] for axis in (0, 1))
    apart = np.hypot(x, y)
    nearest, far = apart.argmin(axis=1), apart.min(axis=1)
    same = (apart.argmin(axis=0)[nearest] == np.arange(len(before))) & (far >= CARRIED_M[0]) & (far <= CARRIED_M[1])
    farther: IntArray = np.stack([now[nearest[same]], before[same]])
    return farther


def _speaking_for(joined: Shown, index: int, without: Shown, at: int, suspects: Collection[str]) -> tuple[str, ...]:
    """Who but the suspects supports a box of the second fusion, and not one of the first."""
    here, there = without.claims.supporting[:, at], joined.claims.supporting[:, index]
    names = compress(joined.claims.witnesses, here & ~there)
    return tuple(name for name in names if name not in suspects)


def gone(joined: Shown, without: Shown, suspects: Collection[str] = ()) -> IntArray:
    """Boxes, by their places in ``without``, that are gone in ``joined`` although others support them."""
    claims = without.claims
    suspected = set(suspects)
    others = np.array([name not in suspected for name in claims.witnesses])
    supported = two_witnesses(claims.supporting & others[:, None])
    supported &= claims.likelihood[others].sum(axis=0) >= WEIGHTY
    lost, rise = joined.beside(without, _lost)
    found: IntArray = np.flatnonzero(supported & lost & (without.boxes[:, 5] >= SHOWN_SCORE) & (rise >= EFFECT))
    return found


def gone_alone(joined: Shown, without: Shown, suspects: Collection[str]) -> IntArray:
    """Boxes, by their places in ``without``, that are gone in ``joined`` although one other teammate supports them with
    certainty, and none but the suspects denies them. In small fusions one message more weighs too much to tell.
    """
    if len(without.teammates) < FEWEST_ALONE:
        return np.zeros(0, dtype=np.int64)
    claims = without.claims.without(suspects)
    supported = (claims.likelihood.max(axis=0) >= CERTAIN) & ~two_witnesses(claims.supporting)
    lost, rise = joined.beside(without, _lost)
    crisp = (without.boxes[:, 5] >= CRISP_SCORE) & (rise >= GONE_EFFECT)
    found: IntArray = np.flatnonzero(supported & ~claims.denying.any(axis=0) & lost & crisp)
    return found


def _lost(joined: Shown, without: Shown) -> tuple[BoolArray, FloatArray]:
    """Which boxes (n,) of the second fusion nothing in the first one shows, and by how much (n,) the logarithm of
    their odds is higher there. None is the ego itself, as others see it.
    """
    shown = joined.boxes[:, 5] >= SHOWN_SCORE
    lost: BoolArray = joined.overlap(without)[shown].max(axis=0, initial=0.0) < SHOWN_IOU
    lost &= np.hypot(*without.boxes[:, :2].T) > OWN_M
    return lost, without.odds_at(without.boxes[:, :2]) - joined.odds_at(without.boxes[:, :2])


def _at(shown: Shown, box: FloatArray) -> int | None:
    """The box of a fusion that overlaps another one most."""
    if not len(shown.boxes):
        return None
    overlap = pairwise_iou(box[None], shown.boxes)[0]
    best = int(overlap.argmax())
    return best if overlap[best] > 0.05 else None
