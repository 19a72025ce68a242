"""Cheap tests of messages before any of them is fused: how large they are, and whether somebody sent them before.

A message is reduced to a `Fingerprint`. What is compared is small, so that it can be kept between frames as JSON and
a decision can be made again from the audit log.

A message is refused only on evidence that cannot be turned against somebody honest:

- its values are far beyond all that honest messages of the detector were seen to hold (``implausible``);
- it is what its sender sent from another place, byte for byte or closer than two scans of one unchanged place ever are
  (``repeated``). A parked vehicle cannot fail that. Nor can one in a tunnel, where all places look the same: it has to
  be closer, too, than what the ego itself sends from two places;
- it is, byte for byte, what the ego has sent (``copied``).

What another teammate had sent first, in a frame of which it is remembered that this one sent something else in it, is
refused as well, and names nobody: it may be its own, sent late, and overheard by the other. Whoever was silent then
stays in. Nor does it name anybody who sends again what it sent not long ago: it may have nothing new.

Two messages that are merely alike are told, and stay in. Nobody can know from the maps who copied. And the maps of an
honest vehicle that drives on an empty road, between walls or in a platoon are as alike as .99.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from robosac.answers import Distrust, Likeness, Reason
from robosac.boxes import FloatArray
from robosac.defenses import EGO, Rejection
from robosac.detectors import Message
from robosac.screening.fingerprints import SKETCH, Fingerprint, fingerprints, likeness, packed, unpacked
from robosac.screening.past import KEPT_FRAMES, Anchor, Past, Place, Sent, is_kept, recent

FRAME_PERIOD_S = 0.2
"""By default."""
MARGIN = 2.0
"""A message may be so many times as large as the largest of the calibration: other worlds have other maps."""
MOVED_M = 3.0
"""From this far on a sender is somewhere else: well beyond what the error of a parked vehicle's pose makes of it."""
STEADIER = 4.0
"""A repetition differs so many times less than two maps of a sender that stands still, or of the ego as it drives."""
NEAR = 0.9
"""From this correlation on a map that was sent elsewhere is told to be alike; honest ones in traffic reach .65."""
ALIKE = 0.8
"""The same for the maps of two vehicles; honest ones in traffic reach .6."""
NAMED_AFTER = 3
"""Refused messages from which on their sender is named as an attacker, while it sends such; but for those that may be
honest.
"""
NOTHING_NEW_S = 1.0
"""What was sent less long ago may be sent again; but for `robosac.screening.past.KEPT_FRAMES` at least."""
MOST_TOLD = 16
"""Likenesses of a frame that are told, the greatest first."""


@dataclass(frozen=True)
class Bounds:
    """What honest messages hold of one tensor."""

    largest: float
    """Absolute value."""
    rms: float
    """Root mean square."""
    still: float
    """The greatest correlation of two successive maps of a sender that does not move, in [-1, 1]."""

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> Bounds:
        """What `as_json` gave."""
        return cls(float(fields["largest"]), float(fields["rms"]), float(fields["still"]))

    def as_json(self) -> dict[str, float]:
        """JSON values."""
        return dict(vars(self))


@dataclass(frozen=True)
class Screened:
    """What the tests of a frame's messages showed."""

    refused: Mapping[str, Rejection]
    """By teammate id."""
    alike: tuple[Likeness, ...]
    """The ego is `robosac.defenses.EGO`."""
    memory: Mapping[str, Any]
    """To be handed to the next frame's tests; JSON values."""


@dataclass(frozen=True)
class Screening:
    """The tests, with what is known of honest messages.

    Parameters
    ----------
    bounds : mapping of tensor name to Bounds
        By default nothing is known: then no message is implausible, and only one that is the same byte for byte is
        refused as a repetition.
    frame_period_s : float
        Time from frame to frame.
    """

    bounds: Mapping[str, Bounds] = field(default_factory=dict)
    frame_period_s: float = FRAME_PERIOD_S

    def screen(self, memory: Mapping[str, Any], frame: int, ego: Message, teammates: Mapping[str, Message]) -> Screened:
        """Test the messages of a frame.

        Parameters
        ----------
        memory : mapping
            What `Screened` held after the frame before; empty at first.
        frame : int
        ego : Message
        teammates : mapping of teammate id to Message
            Without tensors, as of recorded frames, nothing of a message is tested.
        """
        told = {name: message for name, message in sorted(teammates.items()) if message.tensors}
        if not told:
            return Screened({}, (), memory)
        prints = fingerprints({**_comparable(ego, told), **{name: message.tensors for name, message in told.items()}})
        pasts = {name: Past.from_json(memory.get(name)) for name in prints}
        texts = packed(np.stack([one.sketch for one in prints.values()]))
        anchors = {name: past.anchor.text for name, past in pasts.items() if past.anchor is not None}
        before = dict(zip(anchors, unpacked(list(anchors.values())), strict=True))
        seen = {
            name: _Seen(frame, _at(told.get(name, ego)), one, text, pasts[name], before.get(name))
            for (name, one), text in zip(prints.items(), texts, strict=True)
        }
        differs = None if EGO not in seen else seen[EGO].differing
        bound = self._repeating(differs)
        silent = {name: past for name, past in memory.items() if name not in seen and recent(past, frame)}
        known = {**pasts, **{name: Past.from_json(past) for name, past in silent.items()}}
        refused, blamed, earlier = {}, set[str](), _earlier(known, {one.digest for one in prints.values()})
        for name, one in seen.items():
            if name != EGO and (why := self._why_refused(name, seen, earlier, bound)):
                refused[name] = why
                if self._may_be_honest(why, one):
                    continue
                blamed.add(name)
                if one.past.refused + 1 >= NAMED_AFTER:
                    refused[name] = replace(why, distrust=Distrust.NAMED)
        kept = {name: one.remembered(bound, name in blamed, name == EGO) for name, one in seen.items()}
        return Screened(refused, _alike(seen), {**silent, **kept})

    def _why_refused(
        self, name: str, seen: Mapping[str, _Seen], earlier: Mapping[str, Sequence[tuple[str, int]]], bound: float
    ) -> Rejection | None:
        one = seen[name]
        copied = _copied(name, seen, earlier)
        if copied is not None and copied.evidence["of"] == EGO:
            return self._implausible(one) or copied
        return self._implausible(one) or _repeated(one, bound) or copied

    def _may_be_honest(self, why: Rejection, seen: _Seen) -> bool:
        """Whether somebody honest may have sent what is refused."""
        if why.reason is Reason.COPIED:
            return bool(why.evidence["of"] != EGO)
        newest = max(KEPT_FRAMES, math.ceil(NOTHING_NEW_S / self.frame_period_s))
        return why.reason is Reason.REPEATED and 0 < abs(seen.frame - seen.first_sent) < newest

    def _implausible(self, seen: _Seen) -> Rejection | None:
        for name, bounds in self.bounds.items():
            largest, rms = seen.print.sizes.get(name, (0.0, 0.0))
            if largest <= MARGIN * bounds.largest and rms <= MARGIN * bounds.rms:  # false of what is no number
                continue
            shown = {"largest": _finite(largest), "rms": _finite(rms)}
            most = {"most_largest": MARGIN * bounds.largest, "most_rms": MARGIN * bounds.rms}
            return Rejection(Reason.IMPLAUSIBLE, {"tensor": name, **shown, **most})
        return None

    def _repeating(self, differs: float | None) -> float:
        """By how much less two maps from different places have to differ for the later to be a repetition, where those
        of the ego differ by so much; 0 where nothing is known of honest ones.
        """
        if not self.bounds:
            return 0.0
        still = 1.0 - max(bounds.still for bounds in self.bounds.values())
        return (still if differs is None else min(still, differs)) / STEADIER


@dataclass(frozen=True)
class _Seen:
    """A vehicle's message of the frame, beside its past."""

    frame: int
    place: Place
    print: Fingerprint
    text: str
    """Its sketch, `packed`."""
    past: Past
    anchored: FloatArray | None
    """The sketch of its past's anchor, (SKETCH,)."""

    @property
    def first_sent(self) -> int:
        """The frame in which the vehicle sent this very message first."""
        return min((each.first for each in self.past.sent if each.digest == self.print.digest), default=self.frame)

    def sent_in(self, frame: int) -> bool:
        """Whether it is known that the vehicle sent something in a frame before."""
        return any(frame in (each.first, each.last) for each in self.past.sent)

    def moved_from(self, place: Place) -> float:
        return math.dist(self.place, place)

    @property
    def differs(self) -> float | None:
        """1 less the correlation of its map with its anchor; None if that is not from elsewhere."""
        if self.past.anchor is None or self.print.blank or self.moved_from(self.past.anchor.place) <= MOVED_M:
            return None
        assert self.anchored is not None
        return 1.0 - likeness(self.anchored, self.print.sketch)

    @property
    def differing(self) -> float | None:
        """The same of its latest map whose anchor was from elsewhere."""
        return self.past.differs if self.differs is None else round(self.differs, 6)

    def remembered(self, bound: float, blamed: bool, is_ego: bool) -> dict[str, Any]:
        digest, again = self.print.digest, False
        sent = []
        for each in self.past.sent:
            if each.digest == digest:
                again = True
                sent.append(Sent(digest, each.first, self.frame, each.place))
            elif is_kept(each.last, self.frame):
                sent.append(each)
        if not again and not self.print.blank:
            sent.append(Sent(digest, self.frame, self.frame, self.place))
        differs = self.differing if is_ego else None
        return Past(tuple(sent), self._anchor(bound), self.past.refused + blamed, differs).as_json()

    def _anchor(self, bound: float) -> Anchor:
        """The one of before while it is recent and not far; one that repeats itself is kept, to be found out again."""
        before = self.past.anchor
        if before is not None and is_kept(before.frame, self.frame):
            far = self.moved_from(before.place) > MOVED_M
            if not far or _repeated(self, bound) is not None:
                return before
        return Anchor(self.frame, self.place, self.text)


def _repeated(seen: _Seen, bound: float) -> Rejection | None:
    """A map that its sender sent from elsewhere: the same, or one that differs by less than a bound."""
    for sent in seen.past.sent:
        if sent.digest == seen.print.digest and seen.moved_from(sent.place) > MOVED_M:
            return _repetition(seen, sent.first, sent.place, 1.0)
    anchor, differs = seen.past.anchor, seen.differs
    if anchor is None or differs is None or differs >= bound:
        return None
    return _repetition(seen, anchor.frame, anchor.place, 1.0 - differs)


def _earlier(pasts: Mapping[str, Past], digests: Collection[str]) -> dict[str, list[tuple[str, int]]]:
    """By digest, who sent a message, and since which frame."""
    found: dict[str, list[tuple[str, int]]] = {}
    for name, past in pasts.items():
        for sent in past.sent:
            if sent.digest in digests:
                found.setdefault(sent.digest, []).append((name, sent.first))
    return found


def _copied(name: str, seen: Mapping[str, _Seen], earlier: Mapping[str, Sequence[tuple[str, int]]]) -> Rejection | None:
    """What another vehicle sent first. Who of two sent it first in one frame nobody knows, but for the ego."""
    one = seen[name]
    if one.print.blank:
        return None
    if EGO in seen and seen[EGO].print.digest == one.print.digest:
        return Rejection(Reason.COPIED, {"of": EGO, "of_frame": one.frame})
    since = one.first_sent
    for other, first in earlier.get(one.print.digest, ()):
        if (other == EGO and first <= since) or (other not in (EGO, name) and first < since and one.sent_in(first)):
            return Rejection(Reason.COPIED, {"of": other, "of_frame": first})
    return None


def _alike(seen: Mapping[str, _Seen]) -> tuple[Likeness, ...]:
    """Pairs of maps of this frame, and of one of this frame and one sent elsewhere before."""
    names = list(seen)
    now = np.stack([seen[name].print.sketch for name in names])
    together = np.triu(now @ now.T, 1)
    before = {j: one for j, one in enumerate(seen.values()) if one.past.anchor is not None and one.anchored is not None}
    across = np.zeros_like(together)
    across[:, list(before)] = now @ np.reshape([one.anchored for one in before.values()], (-1, SKETCH)).T
    for j, one in before.items():
        assert one.past.anchor is not None
        if across[j, j] < NEAR or one.moved_from(one.past.anchor.place) <= MOVED_M:
            across[j, j] = 0.0
    found = np.concatenate([together.ravel(), across.ravel()])
    alike = np.flatnonzero(found >= ALIKE)
    most = alike[np.argsort(-found[alike], kind="stable")[:MOST_TOLD]]
    told = []
    for then, i, j in zip(*np.unravel_index(most, (2, len(names), len(names))), strict=True):
        anchor = before[j].past.anchor if then else None
        of_frame = seen[names[j]].frame if anchor is None else anchor.frame
        correlation = round(min(float((across if then else together)[i, j]), 1.0), 4)
        told.append(Likeness(vehicle=names[i], other=names[j], of_frame=of_frame, correlation=correlation))
    return tuple(told)


def _repetition(seen: _Seen, frame: int, place: Place, correlation: float) -> Rejection:
    moved = round(seen.moved_from(place), 2)
    return Rejection(
        Reason.REPEATED, {"of_frame": frame, "moved_m": moved, "correlation": round(min(correlation, 1.0), 4)}
    )


def _at(message: Message) -> Place:
    return round(float(message.pose[0, 3]), 2), round(float(message.pose[1, 3]), 2)


def _comparable(ego: Message, teammates: Mapping[str, Message]) -> dict[str, Mapping[str, Any]]:
    """The ego's tensors, if it sends what its teammates send."""
    layout = next(iter(teammates.values())).tensors
    own = {name: tensor for name, tensor in ego.tensors.items() if name in layout}
    same = own.keys() == layout.keys() and all(
        own[name].shape == tensor.shape and own[name].dtype == tensor.dtype for name, tensor in layout.items()
    )
    return {EGO: own} if same else {}


def _finite(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None
