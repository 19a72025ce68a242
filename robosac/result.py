"""What came of a frame: the defence's decision, the boxes, and what it took; and how that is answered."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from robosac.answers import (
    ContradictedBox,
    Distrust,
    FrameAnswer,
    Likeness,
    RejectedTeammate,
    Support,
    TestedHypothesis,
)
from robosac.boxes import FloatArray
from robosac.defenses import EGO, Decision, Outcome, Rejection
from robosac.previous import PreviousAnswer
from robosac.provenance import by_name

DEFAULT_EGO_ID = "ego"
"""What the ego is called in an answer where nobody says otherwise."""


@dataclass(frozen=True, kw_only=True)
class FusionResult(Decision):
    """The answer to one frame: what the defence decided, and what came of it.

    ``objects`` and ``contradicted`` are parallel to the boxes.
    """

    alike: tuple[Likeness, ...] = ()
    """Maps that are strangely alike; the ego is `robosac.defenses.EGO`."""
    unread: tuple[str, ...] = ()
    """Teammates whose testimony there was no time to read."""
    boxes: FloatArray
    """(n, 6) float64: x, y, length, width, yaw, score; ego frame, best first."""
    contradicted_boxes: FloatArray = field(default_factory=lambda: np.zeros((0, 6)))
    """(k, 6) float64: those that are left out of the boxes; as these."""
    hypotheses: tuple[Outcome, ...]
    """In the order tested."""
    deadline_met: bool
    """Whether the answer was ready in time."""
    out_of_time: bool
    """Whether the defence was cut short to meet the deadline."""
    fault: str | None
    """What went wrong inside (`robosac.faults.describe`), if anything; the boxes are then the ego's own."""
    timings_ms: Mapping[str, float]
    """By stage: ``prepare``, ``ego_only``, ``hypotheses`` (decoding), ``consensus`` (matching)."""
    previous: PreviousAnswer | None
    """What the next frame may be compared with; None after an ego-only answer."""

    @property
    def named(self) -> tuple[str, ...] | None:
        """Teammates held to be attackers by the defence, or by the tests of messages in this frame; None from a defence
        that names nobody, where these name nobody either.
        """
        by_defense = super().named
        refused = [name for name, why in self.rejected.items() if why.distrust is Distrust.NAMED]
        if by_defense is None and not refused:
            return None
        return tuple(dict.fromkeys([*(by_defense or ()), *refused]))

    @property
    def sampling_steps(self) -> int:
        """Hypotheses tested."""
        return len(self.hypotheses)

    def support(self, ego_id: str) -> tuple[Support, ...] | None:
        """On whose word each of the boxes stands; None from a defence that does not know."""
        return None if self.objects is None else tuple(by_name(judged.support, ego_id) for judged in self.objects)

    def left_out(self, ego_id: str) -> tuple[ContradictedBox, ...] | None:
        """The boxes that are contradicted and left out; None from a defence that does not know."""
        if self.objects is None:
            return None
        told = (dict(by_name(judged.support, ego_id)) for judged in self.contradicted)
        return tuple(
            ContradictedBox(**support, box=tuple(box))
            for support, box in zip(told, self.contradicted_boxes.tolist(), strict=True)
        )

    def likenesses(self, ego_id: str) -> tuple[Likeness, ...]:
        """Maps that are strangely alike, of vehicles by their ids."""
        return tuple(
            Likeness(
                vehicle=_called(each.vehicle, ego_id),
                other=_called(each.other, ego_id),
                of_frame=each.of_frame,
                correlation=each.correlation,
            )
            for each in self.alike
        )

    def answer(
        self,
        frame: int,
        left_out: Mapping[str, Rejection],
        timings_ms: Mapping[str, float],
        ego_id: str = DEFAULT_EGO_ID,
    ) -> FrameAnswer:
        """What is answered about the frame. Whoever the defence names is told so.

        Parameters
        ----------
        frame : int
        left_out : mapping of vehicle id to Rejection
            Those who were not among the teammates of the fusion.
        timings_ms : mapping of stage to float
        ego_id : str
            What the ego is called among witnesses and deniers.
        """
        named = dict.fromkeys(self.named or (), Distrust.NAMED)
        return FrameAnswer(
            frame=frame,
            boxes=self.boxes,
            support=self.support(ego_id),
            contradicted=self.left_out(ego_id),
            source=self.source,
            accepted=self.accepted,
            rejected={
                name: RejectedTeammate(
                    vehicle_id=name,
                    reason=why.reason,
                    distrust=why.distrust or named.get(name),
                    **_told(why, ego_id),
                )
                for name, why in {**left_out, **self.rejected}.items()
            },
            hypotheses=tuple(
                TestedHypothesis(teammates=o.teammates, jaccard_index=o.jaccard_index, verdict=o.verdict)
                for o in self.hypotheses
            ),
            sampling_steps=self.sampling_steps,
            attacker_ratio=self.attacker_ratio,
            suspicion=None if self.suspicion is None else dict(self.suspicion),
            alike=self.likenesses(ego_id),
            unread=self.unread,
            deadline_met=self.deadline_met,
            degraded_by="fault" if self.fault is not None else "deadline" if self.out_of_time else None,
            timings_ms={stage: round(milliseconds, 3) for stage, milliseconds in timings_ms.items()},
        )


def _called(name: str, ego_id: str) -> str:
    return ego_id if name == EGO else name


def _told(why: Rejection, ego_id: str) -> Mapping[str, Any]:
    """Evidence in which the ego has its id, where it is whom a message is copied from."""
    return {**why.evidence, "of": ego_id} if why.evidence.get("of") == EGO else why.evidence
