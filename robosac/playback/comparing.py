"""What came of decisions that were made again, beside what was recorded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from robosac.evaluation import AveragePrecision
from robosac.playback.replay import Replayed


@dataclass
class Compared:
    """Collects frames that were decided again."""

    frames: int = 0
    same: int = 0
    otherwise: list[Replayed] = field(default_factory=list)
    """Frames whose answers differ."""
    infiltrated: list[int] = field(default_factory=lambda: [0, 0])
    """Answers with a recorded attacker in them: of the recorded ones, and of those made again."""
    recorded: AveragePrecision = field(default_factory=AveragePrecision)
    made: AveragePrecision = field(default_factory=AveragePrecision)
    with_truth: int = 0

    def add(self, replayed: Replayed) -> None:
        """Add a frame."""
        self.frames += 1
        self.same += not replayed.differing
        if replayed.differing:
            self.otherwise.append(replayed)
        frame, truth = replayed.frame, replayed.frame.true_boxes
        if truth is None or frame.truth is None:
            return
        self.with_truth += 1
        for number, (answer, precision) in enumerate(((frame.answer, self.recorded), (replayed.answer, self.made))):
            precision.add(answer.boxes, truth)
            self.infiltrated[number] += not set(frame.truth.attackers).isdisjoint(answer.accepted)

    def lines(self, most: int) -> Iterator[str]:
        """What to print; of the frames that differ, at most so many, and nothing if none is wanted."""
        yield f"  {self.same} of {self.frames} answers are the same"
        for replayed in self.otherwise[:most]:
            yield f"  frame {replayed.frame.number} differs in {', '.join(replayed.differing)}"
        if len(self.otherwise) > most > 0:
            yield f"  and {len(self.otherwise) - most} more"
        if self.with_truth:
            for what, precision, hit in (
                ("recorded", self.recorded, self.infiltrated[0]),
                ("made again", self.made, self.infiltrated[1]),
            ):
                yield (
                    f"  {what}: AP50 {precision.at(0.5):.3f}, AP70 {precision.at(0.7):.3f}, "
                    f"a recorded attacker in {hit} of {self.with_truth} answers"
                )
