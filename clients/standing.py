"""How the boxes of a fleet's answers stand, where the defence knows it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from robosac.answers import FrameAnswer, Standing


@dataclass
class Standings:
    """Counts boxes by status."""

    answered: Counter[Standing] = field(default_factory=Counter)
    left_out: int = 0
    """Contradicted boxes that are in no answer."""
    known: bool = False
    """Whether any answer said how its boxes stand."""

    def add(self, answer: FrameAnswer) -> None:
        """Count one answer."""
        self.known |= answer.support is not None
        self.answered.update(support.status for support in answer.support or ())
        self.left_out += len(answer.contradicted or ())

    def as_dict(self) -> dict[str, Any] | None:
        """Plain values for JSON; None if no answer said how its boxes stand."""
        if not self.known:
            return None
        answered = {standing.value: self.answered[standing] for standing in Standing}
        return {"answered": answered, "contradicted_left_out": self.left_out}

    def sentence(self) -> str | None:
        """For the closing summary; None if no answer said how its boxes stand."""
        if not self.known:
            return None
        total = self.answered.total()
        shares = ", ".join(
            f"{count} {standing.value.replace('_', ' ')} ({count / total:.1%})"
            for standing in Standing
            if (count := self.answered[standing])
        )
        return f"Boxes answered: {shares or 'none'}. Contradicted and left out: {self.left_out}."


def shown(answer: FrameAnswer) -> str:
    """The number of boxes of an answer, and in red how many contradicted ones were left out."""
    left_out = len(answer.contradicted or ())
    return str(len(answer.boxes)) + (f" [red]-{left_out}[/red]" if left_out else "")
