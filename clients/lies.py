"""What became of lies about single objects in a fleet's answers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from clients.simulation import EgoFrame
from robosac.answers import FrameAnswer
from robosac.boxes import FloatArray
from robosac.detectors import PreparedFrame
from robosac.evaluation.objects import ObjectHistory, Shown, judge, object_rates


@dataclass
class Lies:
    """Judges the lies of each ego's sequence."""

    histories: dict[tuple[int, str], ObjectHistory] = field(default_factory=dict)
    """By scene and ego."""
    _struck: dict[tuple[int, str], set[str]] = field(default_factory=dict)

    def add(self, frame: EgoFrame, answer: FrameAnswer, received: PreparedFrame, undefended: FloatArray) -> None:
        """Judge one answered frame.

        Parameters
        ----------
        frame : EgoFrame
        answer : FrameAnswer
            To this frame.
        received : PreparedFrame
            The same frame, to be decoded.
        undefended : (n, 6) ndarray
            What it shows if everybody is fused.
        """
        met = (frame.scene, frame.ego_id)
        history = self.histories.setdefault(met, ObjectHistory())
        struck = self._struck.setdefault(met, set())
        struck |= frame.attackers
        history.all_named.append(bool(struck) and struck <= set(answer.named))
        if not frame.lies:
            history.judged.append(())
            history.undefended.append(())
            return
        ideal = received.detect(sorted(set(frame.sent) - frame.attackers))
        history.judged.append(judge(frame.lies, Shown.of(answer), frame.truth, ideal))
        history.undefended.append(judge(frame.lies, Shown(undefended), frame.truth, ideal))

    def as_dict(self) -> dict[str, Any] | None:
        """Plain values for JSON, as `object_rates` gives them; None if nobody lied about an object."""
        return object_rates(self.histories.values())

    def sentence(self) -> str | None:
        """For the closing summary; None if nobody lied about an object."""
        rates = self.as_dict()
        if rates is None:
            return None
        parts = [
            f"Lies about single objects: told in {rates['held']:.1%} of {rates['object_frames']} object frames, "
            f"at most {rates['longest']} in a row"
        ]
        shares = {"flagged": "flagged", "confirmed": "confirmed", "single_witness": "told on the word of one"}
        parts += [f"{said} in {rates[name]:.1%}" for name, said in shares.items() if rates[name] is not None]
        named = (
            f"all attackers named in {rates['shown_named']} of {rates['sequences_shown']} sequences in which one shows"
        )
        if rates["frames_to_name"] is not None:
            named += f", after {rates['frames_to_name']:.1f} frames on average"
        return f"{', '.join(parts)}; {named}."
