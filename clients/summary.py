"""What a fleet run amounts to: average precision, rejections, steps, latency; as tables, JSON and a picture."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from clients import trial
from clients.lies import Lies
from clients.simulation import EgoFrame
from clients.standing import Standings
from robosac.answers import FrameAnswer
from robosac.boxes import FloatArray
from robosac.calibrated import without_witness
from robosac.consensus import at_least
from robosac.detectors import Detector
from robosac.evaluation import AveragePrecision
from robosac.figures import new_figure, save_figure
from robosac.files import write_text
from robosac.scenes.drawing import TRUE_COLOUR, draw_answer, draw_boxes, draw_points, frame_axes

REPORT = "summary.json"
GATEWAY = "gateway"
BASELINES = ("all benign", "ego only", "no defence")


@dataclass(frozen=True)
class Example:
    """A frame for the picture: who asked, what is true, and what came of it; ``undefended`` from the consensus
    score on.
    """

    frame: EgoFrame
    undefended: FloatArray
    answer: FrameAnswer
    score: float
    """The consensus score."""


Met = tuple[int, str, str]
"""A vehicle as an ego meets it in a scene: scene, ego, vehicle."""


@dataclass
class FleetSummary:
    """Collects answered frames beside what the same frames give without the gateway."""

    detector: Detector
    ap: dict[str, AveragePrecision] = field(
        default_factory=lambda: {n: AveragePrecision() for n in (GATEWAY, *BASELINES)}
    )
    latencies_ms: list[float] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    sources: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    """By problem: requests that the gateway could not serve at first, and that were sent again."""
    lost: int = 0
    """Frames that were decided, whose answers never came."""
    degraded: Counter[str] = field(default_factory=Counter)
    """By what cut the defence short: answers."""
    fault: str | None = None
    """What failed inside the gateway, the first time that it did."""
    with_attacker: int = 0
    in_time: int = 0
    participation: dict[str, Counter[str]] = field(default_factory=dict)
    attacked_from: dict[Met, int] = field(default_factory=dict)
    named_in: dict[Met, int] = field(default_factory=dict)
    names: bool = False
    defense: Mapping[str, Any] | None = None
    """As the gateway took it on."""
    lacks_witness: bool = False
    """As `clients.client.OpenedSession.lacks_witness`."""
    lies: Lies = field(default_factory=Lies)
    standings: Standings = field(default_factory=Standings)
    example: Example | None = None
    _harm: int = -1

    @property
    def frames(self) -> int:
        """Answered frames."""
        return len(self.steps)

    @property
    def clean_share(self) -> float:
        """Share of answers without any attacker's message."""
        return 1.0 - self.with_attacker / self.frames if self.frames else float("nan")

    @property
    def naming(self) -> dict[str, Any] | None:
        """Who was named as an attacker, by scene and ego; None if the defence names nobody."""
        if not self.names:
            return None
        right = self.named_in.keys() & self.attacked_from.keys()
        delays = [self.named_in[met] - self.attacked_from[met] + 1 for met in right]
        return {
            "attackers": len(self.attacked_from),
            "attackers_named": len(right),
            "honest_named": len(self.named_in.keys() - self.attacked_from.keys()),
            "frames_until_named": float(np.mean(delays)) if delays else None,
        }

    def add(self, frame: EgoFrame, answer: FrameAnswer, latency_ms: float) -> None:
        """Count one answered frame."""
        team = list(frame.sent)
        received = self.detector.prepare(frame.message, frame.sent)
        undefended = received.detect(team)
        self.ap[GATEWAY].add(answer.boxes, frame.truth)
        self.ap["all benign"].add(
            self.detector.prepare(frame.message, frame.benign).detect(list(frame.benign)), frame.truth
        )
        self.ap["ego only"].add(received.detect(), frame.truth)
        self.ap["no defence"].add(undefended, frame.truth)
        self.latencies_ms.append(latency_ms)
        self.steps.append(answer.sampling_steps)
        self.sources[answer.source.value] += 1
        self.with_attacker += not frame.attackers.isdisjoint(answer.accepted)
        self.in_time += answer.deadline_met
        if answer.degraded_by is not None:
            self.degraded[answer.degraded_by] += 1
        evidence = (entry.model_extra or {} for entry in answer.rejected.values())
        self.fault = self.fault or next((str(told["fault"]) for told in evidence if "fault" in told), None)
        for vehicle in frame.attackers:
            self.attacked_from.setdefault((frame.scene, frame.ego_id, vehicle), answer.frame)
        for vehicle in answer.named:
            self.named_in.setdefault((frame.scene, frame.ego_id, vehicle), answer.frame)
        self.names |= answer.suspicion is not None or bool(answer.named)
        self.lies.add(frame, answer, received, undefended)
        self.standings.add(answer)
        for role, members in (("attackers", frame.attackers), ("honest", set(team) - frame.attackers)):
            tally = self.participation.setdefault(role, Counter())
            for vehicle in members:
                tally["accepted" if vehicle in answer.accepted else answer.rejected[vehicle].reason.value] += 1
        self._keep_example(frame, undefended, answer)

    def _keep_example(self, frame: EgoFrame, undefended: FloatArray, answer: FrameAnswer) -> None:
        """The picture shows the frame where the attacked fusion finds most too many or too few boxes, rather one with a
        verified answer.
        """
        score = self.detector.info.consensus_score
        found = at_least(undefended, score)
        harm = abs(len(found) - len(frame.truth)) * 2 + (answer.source != "ego_only")
        if harm > self._harm:
            self._harm = harm
            self.example = Example(frame, found, answer, score)

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "frames": self.frames,
            "defense": self.defense,
            "lacks_witness": self.lacks_witness,
            "average_precision": {name: {"ap50": ap.at(0.5), "ap70": ap.at(0.7)} for name, ap in self.ap.items()},
            "clean_share": self.clean_share,
            "answers_with_attacker": self.with_attacker,
            "sources": dict(self.sources),
            "participation": {role: dict(tally) for role, tally in self.participation.items()},
            "naming": self.naming,
            "objects": self.lies.as_dict(),
            "boxes": self.standings.as_dict(),
            "sampling_steps": {"mean": float(np.mean(self.steps)), "max": int(np.max(self.steps))},
            "latency_ms": trial.percentiles(self.latencies_ms),
            "deadline_met_share": self.in_time / self.frames,
            "refused_first": dict(self.refused),
            "answers_lost": self.lost,
            "degraded": dict(self.degraded),
            "fault": self.fault,
        }

    def print(self, console: Console) -> None:
        """The closing summary."""
        values = self.as_dict()
        title = f"Average precision on the same {self.frames} frames"
        table = trial.a_table(title, ["perception", "AP at IoU 0.5", "AP at IoU 0.7"])
        labels = {
            "all benign": "all teammates benign (the ideal)",
            GATEWAY: "[bold]what the gateway answered[/bold]",
            "ego only": "ego alone",
            "no defence": "attacked, no defence",
        }
        for name, label in labels.items():
            ap = values["average_precision"][name]
            table.add_row(label, f"{ap['ap50']:.3f}", f"{ap['ap70']:.3f}")
        console.print(table)
        reasons = sorted({reason for tally in self.participation.values() for reason in tally} - {"accepted"})
        headings = [heading.replace("_", " ") for heading in ("", "accepted", *reasons)]
        table = trial.a_table("Who was accepted, and why not (vehicle-frames)", headings)
        for role, tally in self.participation.items():
            if tally:
                table.add_row(role, *(str(tally[column]) for column in ("accepted", *reasons)))
        console.print(table)
        if self.defense is not None:
            error_m = self.defense.get("pose_error_m")
            expecting = "" if error_m is None else f", expecting positions to be wrong by {error_m:g} m"
            console.print(f"Defence: {self.defense['kind']}{expecting}.")
        if self.lacks_witness:
            console.print(f"{without_witness(self.detector.info.name)}.", markup=False)
        latency, steps = values["latency_ms"], values["sampling_steps"]
        sources = ", ".join(f"{count} {source.replace('_', ' ')}" for source, count in self.sources.most_common())
        console.print(
            f"Answers: {sources}. Sampling steps: {steps['mean']:.2f} a frame, at most {steps['max']}.\n"
            f"Latency over HTTP: median {latency['p50']:.1f} ms, 95 % {latency['p95']:.1f} ms, "
            f"99 % {latency['p99']:.1f} ms; "
            f"{values['deadline_met_share']:.1%} in time by the gateway's clock."
        )
        if self.degraded:
            causes = {"deadline": "the deadline", "fault": "a fault"}
            cut = ", ".join(f"{count} by {causes[cause]}" for cause, count in self.degraded.items())
            why = f" The first fault: {self.fault}" if self.fault is not None else ""
            console.print(f"Cut short: {cut}.{why}", markup=False)
        if count := self.refused.total():
            requests = "request was" if count == 1 else "requests were"
            console.print(f"{count} {requests} refused first ({', '.join(self.refused)}) and sent again.")
        if self.lost:
            answers = "answer was" if self.lost == 1 else "answers were"
            console.print(f"{self.lost} {answers} lost: the database took longer than a frame has.")
        if (naming := values["naming"]) is not None:
            after = naming["frames_until_named"]
            console.print(
                f"Named as attackers: {naming['attackers_named']} of {naming['attackers']}"
                + (f", after {after:.1f} frames on average" if after is not None else "")
                + f"; honest teammates named: {naming['honest_named']}."
            )
        if (told := self.lies.sentence()) is not None:
            console.print(told)
        if (standings := self.standings.sentence()) is not None:
            console.print(standings)
        colour = "green" if self.clean_share >= 0.95 else "red"
        console.print(f"[{colour}]No attacker accepted in {self.clean_share:.1%} of the frames.[/{colour}]")

    def write(self, folder: Path, settings: dict[str, Any]) -> Path:
        """Write ``summary.json`` and ``example.png`` to a folder; returns the picture's path."""
        text = json.dumps({"settings": settings, **self.as_dict()}, indent=2)
        write_text(folder / REPORT, text + "\n")
        picture = folder / "example.png"
        if self.example is not None:
            _draw(self.example, picture)
        return picture


def _draw(example: Example, path: Path) -> None:
    frame, answer = example.frame, example.answer
    attack = f"attacked by {', '.join(sorted(frame.attackers))}" if frame.attackers else "nobody attacks"
    panels = (
        ("True boxes", frame.truth, TRUE_COLOUR, "true"),
        (f"Fusion of all, {attack}", example.undefended, "#b2182b", "found"),
        (f"Gateway: {answer.source.replace('_', ' ')} with {', '.join(answer.accepted) or 'nobody'}", None, "", ""),
    )
    figure = new_figure(21, 7.6)
    for axes, (title, boxes, colour, label) in zip(figure.subplots(1, 3), panels, strict=True):
        draw_points(axes, frame.points)
        if boxes is not frame.truth:
            draw_boxes(axes, frame.truth, TRUE_COLOUR, "true", dashed=True, width=1.0)
        if boxes is None:
            draw_answer(axes, answer, example.score)
        else:
            draw_boxes(axes, boxes, colour, label)
        frame_axes(axes, title)
    figure.suptitle(f"Scene {frame.scene}, frame {answer.frame}, {frame.ego_id}; boxes from the consensus score on")
    save_figure(figure, path, dpi=90, bbox_inches="tight")
