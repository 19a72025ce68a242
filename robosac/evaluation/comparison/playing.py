"""Plays every defence on the same test sequences."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from robosac.boxes import FloatArray
from robosac.defenses import Defense
from robosac.detectors import Detector
from robosac.evaluation.average_precision import Matched, match
from robosac.evaluation.comparison.settings import Extent, Setting
from robosac.evaluation.encounters import Encounters
from robosac.evaluation.frames import EvaluationFrame, another_scene
from robosac.evaluation.objects import Judged, ObjectHistory, Shown, judge
from robosac.evaluation.playing import FaultyDefense, play
from robosac.evaluation.recordings import Recordings
from robosac.evaluation.standing import TrueBoxes, true_boxes
from robosac.scenes import Scene, SceneError, SceneSource, first_scenes
from robosac.scenes.intersection import Synthetic

ORACLE = "oracle"
EGO_ONLY = "ego only"
MOST_RECORDED = 8
"""Teammates of a scene of whose frames all subsets are recorded."""


@dataclass(frozen=True)
class Plan:
    """What is played."""

    detector: Detector
    defenses: Mapping[str, Defense]
    extent: Extent
    seed: int = 0
    """Of attackers, attacks and draws."""
    recordings: Path | None = None
    """Folder in which recorded frames are kept and looked for."""
    pose_error_m: float = 0.0
    """Of the teammates, as `Encounters` takes it."""
    live: bool = False
    """Record nothing: each defence decodes for itself, and is timed."""
    data: SceneSource = field(default_factory=Synthetic)
    kept: Path | None = None
    """Folder in which each sequence is kept that is played, and from which those are taken that are there."""
    code: str = ""
    """Digest of the user's own code of attacks, detector and scenes; what is recorded belongs to it."""

    def scenes(self) -> list[Scene]:
        """The scenes that are played.

        Raises
        ------
        SceneError
            If the source has too few, or they are too short or have too few teammates for the settings.
        """
        team = max(1, *(setting.attackers for setting in self.extent.settings))
        scenes = first_scenes(self.data, "test", self.extent.scenes, self.extent.frames, team)
        largest = max(len(scene.agents) - 1 for scene in scenes)
        if largest > MOST_RECORDED and not self.live:
            raise SceneError(
                f"{self.data.name} has {largest} teammates in a scene: {2**largest} subsets would be recorded in each "
                "frame; compare live, so that only those are decoded that a defence asks for"
            )
        return scenes

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of what has a row in each setting."""
        return (ORACLE, *self.defenses, EGO_ONLY)


@dataclass(frozen=True)
class Naming:
    """Whom a defence named in a sequence."""

    struck: int
    """Attackers that acted in it."""
    after: tuple[int, ...]
    """Of each of them that was named: frames since its first strike, at least 1."""
    all_after: int | None
    """Frames since the first strike of all until all attackers were named together; None if they never were."""
    honest_named: int
    honest: int
    """Honest teammates that were ever named, and all of them."""


@dataclass
class Played:
    """What one defence did in one sequence; lists are by frame."""

    matched: list[Matched] = field(default_factory=list)
    """Its answers."""
    infiltrated: list[bool] = field(default_factory=list)
    """Whether an attacking message is in the answer."""
    refused: list[int] = field(default_factory=list)
    honest: list[int] = field(default_factory=list)
    """Honest messages that are not in the answer, and all of them."""
    passes: list[int] = field(default_factory=list)
    """Fused."""
    milliseconds: list[float] = field(default_factory=list)
    """Empty unless live."""
    naming: Naming | None = None
    """None where the defence names nobody."""
    objects: ObjectHistory = field(default_factory=ObjectHistory)
    """What became of the lies about single objects, if there were any."""
    standing: list[TrueBoxes] = field(default_factory=list)
    """How the true boxes stand; empty from a defence that does not know."""

    def add(self, frame: EvaluationFrame, matched: Matched, accepted: Collection[str], passes: int) -> None:
        """Add a frame."""
        self.matched.append(matched)
        self.infiltrated.append(not frame.attackers.isdisjoint(accepted))
        self.refused.append(sum(name not in accepted for name in frame.honest))
        self.honest.append(len(frame.honest))
        self.passes.append(passes)


PlayedScene = dict[tuple[Setting, str], Played]


def play_scene(plan: Plan, scene: Scene, tick: Callable[[], None] = lambda: None) -> PlayedScene:
    """Every defence in every setting, in one scene. ``tick`` is called after each frame of each setting.

    Raises
    ------
    FaultyDefense
        If a defence fails.
    """
    what = (plan.detector, scene, plan.seed, plan.pose_error_m, another_scene(plan.data, "test", scene))
    source = Encounters(*what) if plan.live else Recordings(*what, plan.recordings, plan.data.name, plan.code)
    played: PlayedScene = {}
    for setting in plan.extent.settings:
        chosen = attackers(scene, setting.attackers, plan.seed)
        sequence = source.sequence(plan.extent.frames, setting.campaign, chosen, tick)
        matcher, judge_lies = _Matcher(sequence), _Judge(sequence)
        played[setting, ORACLE] = _reference(sequence, matcher, judge_lies, lambda frame: frame.honest)
        for name, defense in plan.defenses.items():
            rng = np.random.default_rng([plan.seed, scene.number, zlib.crc32(name.encode())])
            try:
                played[setting, name] = _play(defense, sequence, matcher, judge_lies, chosen, rng)
            except FaultyDefense as fault:
                raise FaultyDefense(f"{name}, {fault}") from fault
        played[setting, EGO_ONLY] = _reference(sequence, matcher, judge_lies, lambda _: ())
    return played


def attackers(scene: Scene, count: int, seed: int) -> list[str]:
    """Teammates of the scene that are under the adversary's control; the same ones and more with a higher count."""
    team = sorted(set(scene.agents) - {scene.egos[0]})
    order = np.random.default_rng([seed, scene.number]).permutation(len(team))
    return [team[i] for i in order[:count]]


class _Matcher:
    """Matches each answer to a frame of a sequence once, however many defences give it."""

    def __init__(self, sequence: Sequence[EvaluationFrame]) -> None:
        self._sequence = sequence
        self._known: dict[tuple[int, bytes], Matched] = {}

    def __call__(self, index: int, boxes: FloatArray) -> Matched:
        key = (index, boxes.tobytes())
        if key not in self._known:
            self._known[key] = match(boxes, self._sequence[index].truth)
        return self._known[key]


class _Judge:
    """Judges what is answered of the lies of a sequence."""

    def __init__(self, sequence: Sequence[EvaluationFrame]) -> None:
        self._sequence = sequence
        self._ideal = [_fused(frame, frame.honest) if frame.lies else np.empty((0, 6)) for frame in sequence]
        self.undefended = [
            self(index, Shown(_fused(frame, frame.team))) if frame.lies else () for index, frame in enumerate(sequence)
        ]

    def __call__(self, index: int, shown: Shown) -> tuple[Judged, ...]:
        frame = self._sequence[index]
        return judge(frame.lies, shown, frame.truth, self._ideal[index])


def _fused(frame: EvaluationFrame, subset: Collection[str]) -> FloatArray:
    return frame.prepare(frame.ego, frame.teammates).detect(subset)


def _reference(
    sequence: Sequence[EvaluationFrame],
    matcher: _Matcher,
    judge_lies: _Judge,
    choose: Callable[[EvaluationFrame], tuple[str, ...]],
) -> Played:
    """Fuse what is chosen in each frame, whatever it looks like."""
    played = Played(objects=ObjectHistory(undefended=judge_lies.undefended))
    for index, frame in enumerate(sequence):
        accepted = choose(frame)
        boxes = _fused(frame, accepted)
        played.add(frame, matcher(index, boxes), accepted, int(bool(accepted)))
        played.objects.judged.append(judge_lies(index, Shown(boxes)))
    return played


def _play(
    defense: Defense,
    sequence: Sequence[EvaluationFrame],
    matcher: _Matcher,
    judge_lies: _Judge,
    chosen: Collection[str],
    rng: np.random.Generator,
) -> Played:
    """One sequence as a session, with the defence's memory."""
    played = Played(objects=ObjectHistory(undefended=judge_lies.undefended))
    named: list[tuple[str, ...] | None] = []
    for index, (frame, answer) in enumerate(zip(sequence, play(defense, sequence, rng), strict=True)):
        result = answer.result
        played.add(frame, matcher(index, result.boxes), result.accepted, answer.passes)
        played.milliseconds.append(answer.milliseconds)
        named.append(result.named)
        shown = Shown.of(result.answer(index, {}, {})) if frame.lies or result.objects is not None else None
        played.objects.judged.append(judge_lies(index, shown) if frame.lies and shown is not None else ())
        if shown is not None and shown.standing is not None:
            played.standing.append(true_boxes(shown, frame.truth))
        played.objects.all_named.append(bool(chosen) and set(chosen) <= set(result.named or ()))
    if any(names is not None for names in named):
        played.naming = _naming(sequence, [frozenset(names or ()) for names in named], chosen)
    return played


def _naming(sequence: Sequence[EvaluationFrame], named: Sequence[frozenset[str]], chosen: Collection[str]) -> Naming:
    hostile = frozenset(chosen).union(*(frame.attackers for frame in sequence))  # in recordings others may be, too
    strikes: dict[str, int] = {}
    after: dict[str, int] = {}
    all_after: int | None = None
    for index, frame in enumerate(sequence):
        for name in frame.attackers:
            strikes.setdefault(name, index)
        for name in named[index] & set(strikes):
            after.setdefault(name, index - strikes[name] + 1)
        if strikes and all_after is None and named[index] >= hostile:
            all_after = index - min(strikes.values()) + 1
    honest = {name for frame in sequence for name in frame.team} - hostile
    return Naming(
        struck=len(strikes),
        after=tuple(after[name] for name in sorted(after)),
        all_after=all_after,
        honest_named=len(honest & frozenset[str]().union(*named)),
        honest=len(honest),
    )
