"""Frames as their egos meet them: messages, some of them an attacker's, and true boxes."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations

import numpy as np

from robosac.answers import Verdict
from robosac.attacks import Attack, Campaign
from robosac.attacks.situation import Foreign, Lie, Past
from robosac.boxes import FloatArray, pose_matrix
from robosac.calibrated import witness_of
from robosac.consensus import DEFAULT_THRESHOLD, at_least, compare
from robosac.defenses import EGO, Defense
from robosac.detectors import Detector, DetectorInfo, Message, PreparedFrame
from robosac.detectors.base import check_boxes, for_role
from robosac.fusion import FusionResult, fuse
from robosac.scenes import Frame, Scene, SceneError, SceneSource, Split, encoded, seconds_apart
from robosac.testimony import Testimony

Subset = frozenset[str]
YAW_PER_METRE = np.deg2rad(2.0)
"""Standard deviation of the heading's error for each metre of the position's."""


@dataclass(frozen=True)
class EvaluationFrame:
    """One frame as its ego meets it."""

    detector: Detector
    ego: Message
    benign: Mapping[str, Message]
    """By teammate: what honest teammates would send, of those of whom that is known."""
    teammates: Mapping[str, Message]
    """By teammate: what is received; the attackers' messages stand in the place of their benign ones."""
    attackers: frozenset[str]
    """Those whose message of this frame is not what an honest one would send."""
    truth: FloatArray
    """(G, 5): true boxes; ego frame."""
    lies: tuple[Lie, ...] = field(default=(), kw_only=True)
    """What the attack says that it lies about; none for attacks that are on no object."""

    @property
    def info(self) -> DetectorInfo:
        """The detector's."""
        return self.detector.info

    @property
    def honest(self) -> tuple[str, ...]:
        """Teammates that do not attack in this frame, sorted."""
        return tuple(name for name in self.team if name not in self.attackers)

    @property
    def team(self) -> tuple[str, ...]:
        """Teammates, sorted."""
        return tuple(sorted(self.teammates))

    def prepare(self, ego: Message, teammates: Mapping[str, Message]) -> PreparedFrame:
        """As the detector does."""
        return self.detector.prepare(ego, teammates)

    def testify(self, ego: Message, teammates: Mapping[str, Message]) -> Testimony | None:
        """As the detector's witness does."""
        witness = witness_of(self.info)
        return None if witness is None else witness.testify(EGO, {EGO: ego, **teammates})


@dataclass(frozen=True)
class DecodedOnce(EvaluationFrame):
    """A frame in which each subset is decoded once, whoever asks."""

    boxes: dict[Subset, FloatArray] = field(default_factory=dict)
    """By subset: the boxes (n, 6) that have been decoded; the empty subset is the ego alone."""

    @classmethod
    def of(cls, frame: EvaluationFrame) -> DecodedOnce:
        """The same frame; nothing of it is decoded yet."""
        return cls(**{name: getattr(frame, name) for name in EvaluationFrame.__dataclass_fields__})

    @cached_property
    def heard(self) -> Testimony | None:
        """What the witness makes of all messages, read once."""
        return super().testify(self.ego, self.teammates)

    def testify(self, ego: Message, teammates: Mapping[str, Message]) -> Testimony | None:  # noqa: ARG002 (always the same)
        """What has been heard."""
        return self.heard

    @cached_property
    def _prepared(self) -> PreparedFrame:
        return self.detector.prepare(self.ego, self.teammates)

    def prepare(self, ego: Message, teammates: Mapping[str, Message]) -> PreparedFrame:  # noqa: ARG002 (always the same)
        """The frame itself."""
        return self

    def detect(self, teammates: Collection[str] = ()) -> FloatArray:
        """Boxes (n, 6) of a subset."""
        key = frozenset(teammates)
        if key not in self.boxes:
            self.boxes[key] = check_boxes(self._prepared.detect(teammates))
        return self.boxes[key]

    def confident(self, teammates: Collection[str] = ()) -> FloatArray:
        """Boxes of a subset that take part in the consensus test."""
        return at_least(self.detect(teammates), self.info.consensus_score)

    def answers(self, defense: Defense, seed: Sequence[int], repeats: int) -> list[FusionResult]:
        """What a defence answers that has met nobody yet, each time with draws of its own."""
        return [
            fuse(self, defense, self.ego, self.teammates, rng=np.random.default_rng([*seed, repeat]))
            for repeat in range(repeats)
        ]

    def judged(self, size: int, threshold: float = DEFAULT_THRESHOLD) -> tuple[list[bool], list[bool]]:
        """The consensus test of all hypotheses of a size.

        Returns
        -------
        refused, missed : list of bool
            Of each without an attacker whether it is in dissensus; of each other one whether it is in consensus.
        """
        refused, missed = [], []
        for subset in combinations(self.team, size):
            verdict = compare(self.confident(), self.confident(subset), threshold).verdict
            if self.attackers.isdisjoint(subset):
                refused.append(verdict is Verdict.DISSENSUS)
            else:
                missed.append(verdict is Verdict.CONSENSUS)
        return refused, missed


def encode_all(detector: Detector, frame: Frame) -> dict[str, Message]:
    """Every agent's message, with all that it would send as an ego."""
    return {name: encoded(view, detector) for name, view in frame.views.items()}


def misplaced(message: Message, pose_error_m: float, rng: np.random.Generator) -> Message:
    """A message whose sender is wrong about where it is: normal errors in x, y and heading."""
    if not pose_error_m:
        return message
    pose = message.pose
    dx, dy = rng.normal(0.0, pose_error_m, 2)
    turn = pose_matrix(0.0, 0.0, 0.0, rng.normal(0.0, pose_error_m * YAW_PER_METRE))
    wrong = pose.copy()
    wrong[:3, :3] = turn[:3, :3] @ pose[:3, :3]
    wrong[:2, 3] += dx, dy
    return Message(wrong, message.tensors)


@dataclass(frozen=True)
class Sensed:
    """One frame before anybody attacks."""

    index: int
    """Its number in the scene, which a campaign's schedule goes by."""
    ego_id: str
    messages: Mapping[str, Message]
    """By agent: everybody's, the ego's among them, each with all that it would send as an ego."""
    truth: FloatArray
    """(G, 5): true boxes; ego frame."""
    vehicles: FloatArray | None = None
    """(V, 5): all other vehicles around the ego as far as the scene tells, what an adversary can know; ego frame. None
    if that is `truth`.
    """
    hostile: frozenset[str] = frozenset()
    """Agents of whom it is known that their messages are attacks already, as in a recording."""

    @classmethod
    def of(cls, detector: Detector, frame: Frame, ego_id: str, pose_error_m: float, rng: np.random.Generator) -> Sensed:
        """Encode all views; each teammate is wrong about its pose, as `misplaced` has it.

        Raises
        ------
        SceneError
            If the ego is not in the frame.
        """
        if ego_id not in frame.views:
            raise SceneError(f"frame {frame.index}: {ego_id} is to be the ego, and is not there")
        messages = encode_all(detector, frame)
        placed = {n: m if n == ego_id else misplaced(m, pose_error_m, rng) for n, m in messages.items()}
        vehicles = vehicles_around(frame, ego_id)
        return cls(frame.index, ego_id, placed, frame.truth(ego_id), vehicles, hostile_in(frame))


def vehicles_around(frame: Frame, ego_id: str) -> FloatArray:
    """All other vehicles around an ego, (V, 5) in its frame: those of `nearby` where a frame has that, else of
    `truth`.
    """
    nearby = getattr(frame, "nearby", None)
    return frame.truth(ego_id) if nearby is None else np.asarray(nearby(ego_id)[0])


def hostile_in(frame: Frame) -> frozenset[str]:
    """Agents whose messages are attacks before anybody attacks: those that a frame names ``attackers``, or nobody."""
    return frozenset(getattr(frame, "attackers", ()))


def foreign_views(detector: Detector, scene: Scene | None) -> Foreign | None:
    """What agents sense in another scene, for adversaries that replay it; without a scene there is none.

    An agent that is not there is given the view of another one, the last by name.
    """
    if scene is None:
        return None

    def message(name: str, index: int) -> Message | None:
        frame = scene.frame(index if scene.length is None else min(index, scene.length - 1))
        views = frame.views
        view = views.get(name) or views.get(max(views, default=""))
        if view is None:
            return None
        return for_role(encoded(view, detector), detector.info, "teammate")

    return message


def another_scene(source: SceneSource, split: Split, scene: Scene) -> Scene | None:
    """The scene after this one in its source, the first after the last; None if there is no other."""
    scenes = source.scenes(split)
    numbers = [other.number for other in scenes]
    if scene.number not in numbers or len(scenes) < 2:
        return None
    return scenes[(numbers.index(scene.number) + 1) % len(scenes)]


def under_attack(
    detector: Detector,
    sensed: Sensed,
    attackers: Collection[str],
    attack: Attack | Campaign,
    rng: np.random.Generator,
    past: Past | None = None,
) -> EvaluationFrame:
    """One frame with some teammates under the adversary's control, who optimises their messages together.

    Those who are not in the frame send nothing. Whoever is hostile without that counts as an attacker, too; what
    it would send as an honest vehicle is not known.

    Parameters
    ----------
    rng : numpy.random.Generator
        The attack's.
    past : Past, optional
        What the adversary has of the sequence, to be handed from frame to frame; by default nothing.
    """
    past = Past() if past is None else past
    ego = sensed.messages[sensed.ego_id]
    others = {name: message for name, message in sensed.messages.items() if name != sensed.ego_id}
    benign = {name: for_role(message, detector.info, "teammate") for name, message in others.items()}
    present = [name for name in attackers if name in benign]
    known = sensed.truth if sensed.vehicles is None else sensed.vehicles
    situation = past.situation(sensed.index, ego, benign, known)
    sent = Campaign.of(attack).messages(detector, ego, benign, present, sensed.index, rng, situation)
    past.keep(sensed.index, benign)
    received, lies = {**benign, **sent}, tuple(situation.lies)
    hostile = frozenset(sent) | (sensed.hostile & benign.keys())
    honest = {name: message for name, message in benign.items() if name not in sensed.hostile}
    return EvaluationFrame(detector, ego, honest, received, hostile, sensed.truth, lies=lies)


def evaluation_frames(  # who senses where, and what is drawn: callers vary all of it
    detector: Detector,
    scenes: Iterable[Scene],
    frames_per_scene: int,
    attack: Attack | Campaign,
    attackers: int,
    rng: np.random.Generator,
    team: int = 1,
) -> Iterator[EvaluationFrame | None]:
    """Frames 1 s apart of every scene, its vehicles taking turns as ego, random teammates attacking.

    Yields
    ------
    EvaluationFrame or None
        None for a frame in which there is no ego, or fewer than ``team`` teammates.
    """
    turn = 0
    for scene in scenes:
        for frame in seconds_apart(scene, frames_per_scene):
            egos = [name for name in scene.egos if name in frame.views]
            if not egos or len(frame.views) - 1 < team:
                yield None
                continue
            ego_id = egos[turn % len(egos)]
            turn += 1
            drawn = rng.choice(sorted(set(frame.views) - {ego_id}), attackers, replace=False)
            sensed = Sensed.of(detector, frame, ego_id, 0.0, rng)
            yield under_attack(detector, sensed, [str(name) for name in drawn], attack, rng)
