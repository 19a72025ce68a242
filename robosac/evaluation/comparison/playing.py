"""Plays every defence on the same recorded sequences, and sums up what it did."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from robosac.attacks import Campaign, load_campaign
from robosac.boxes import FloatArray
from robosac.defenses import Defense
from robosac.detectors import Detector, Message
from robosac.detectors.base import for_role
from robosac.evaluation.average_precision import AveragePrecision
from robosac.evaluation.comparison.settings import Extent, Setting
from robosac.evaluation.frames import DecodedOnce, EvaluationFrame, encode_all, under_attack
from robosac.fusion import fuse
from robosac.previous import PreviousAnswer
from robosac.scenes import IntersectionScene, SceneFrame
from robosac.scenes.splits import TEST_SEEDS

EGO = "car-1"
EARLY = 5
"""The frames after these count as steady."""
ORACLE = "oracle"
EGO_ONLY = "ego only"


class FaultyDefense(RuntimeError):
    """A defence failed on a frame; an evaluation must not answer over that."""


@dataclass(frozen=True)
class Row:
    """What one defence did in one setting, over all frames.

    Attributes
    ----------
    setting : Setting
    defense : str
        Or `ORACLE`, the fusion of everybody who is honest in the frame, or `EGO_ONLY`.
    ap50, ap70 : float
    passes_first, passes_early, passes_steady : float
        Fused passes a frame: in the first, in frames 2 to 5, and afterwards.
    infiltrated : float
        Share of frames with an attacking message in the answer.
    honest_refused : float or None
        Share of honest messages left out of the answers; None where there are none.
    named_all : float or None
        Share of sequences in which all attackers were named; None where the defence names nobody or nobody attacks.
    frames_to_name : float or None
        Frames from the first strike until all attackers are named, the mean over those sequences.
    honest_named : float or None
        Share of honest teammates that were ever named; None where the defence names nobody.
    """

    setting: Setting
    defense: str
    ap50: float
    ap70: float
    passes_first: float
    passes_early: float
    passes_steady: float
    infiltrated: float
    honest_refused: float | None
    named_all: float | None = None
    frames_to_name: float | None = None
    honest_named: float | None = None


class CountedFrame(DecodedOnce):
    """A test frame in which each subset is decoded once, whoever asks, and fused passes are counted for each who does.

    Parameters
    ----------
    detector : Detector
    met : EvaluationFrame
    honest : DecodedOnce
        The same frame without an attack, shared by all settings.

    Attributes
    ----------
    passes : int
        Fused subsets asked for since it was set to 0.
    """

    def __init__(self, detector: Detector, met: EvaluationFrame, honest: DecodedOnce) -> None:
        super().__init__(detector, met.ego, met.received)
        self.met = met
        self.passes = 0
        self._honest = honest

    def detect(self, teammates: Collection[str] = ()) -> FloatArray:
        """Boxes of a subset; a fused one is a pass. Subsets without an attacker are those of the honest frame."""
        self.passes += bool(teammates)
        return self._honest.detect(teammates) if self.met.attackers.isdisjoint(teammates) else super().detect(teammates)


@dataclass(frozen=True)
class _Sensed:
    """A frame before anybody attacks."""

    messages: Mapping[str, Message]
    truth: FloatArray
    honest: DecodedOnce

    @classmethod
    def of(cls, detector: Detector, frame: SceneFrame) -> _Sensed:
        messages = encode_all(detector, frame)
        teammates = {n: for_role(m, detector.info, "teammate") for n, m in messages.items() if n != EGO}
        return cls(messages, frame.truth(EGO), DecodedOnce(detector, messages[EGO], teammates))


@dataclass
class _Tally:
    """One row in the making."""

    ap: AveragePrecision = field(default_factory=AveragePrecision)
    passes: list[list[int]] = field(default_factory=lambda: [[], [], []])
    infiltrated: list[bool] = field(default_factory=list)
    refused: list[bool] = field(default_factory=list)
    names: bool = False
    all_named_after: list[int | None] = field(default_factory=list)
    honest_named: list[bool] = field(default_factory=list)

    def add(self, index: int, frame: CountedFrame, boxes: FloatArray, accepted: Collection[str], passes: int) -> None:
        met = frame.met
        self.ap.add(boxes, met.truth)
        self.passes[0 if index == 0 else 1 if index < EARLY else 2].append(passes)
        self.infiltrated.append(not met.attackers.isdisjoint(accepted))
        self.refused += [name not in accepted for name in met.received if name not in met.attackers]

    def row(self, setting: Setting, defense: str) -> Row:
        first, early, steady = (float(np.mean(values)) if values else float("nan") for values in self.passes)
        found = [after for after in self.all_named_after if after is not None]
        return Row(
            setting,
            defense,
            self.ap.at(0.5),
            self.ap.at(0.7),
            first,
            early,
            steady,
            infiltrated=float(np.mean(self.infiltrated)),
            honest_refused=float(np.mean(self.refused)) if self.refused else None,
            named_all=len(found) / len(self.all_named_after) if self.names and self.all_named_after else None,
            frames_to_name=float(np.mean(found)) if self.names and found else None,
            honest_named=float(np.mean(self.honest_named)) if self.names and self.honest_named else None,
        )


def compare_defenses(
    detector: Detector,
    defenses: Mapping[str, Defense],
    extent: Extent,
    seed: int = 0,
    tick: Callable[[], None] = lambda: None,
) -> list[Row]:
    """Every defence in every setting.

    A frame's subsets are decoded once, whichever defence asks first, so a further defence costs little. The rows of a
    defence depend neither on the other defences nor on the other settings. A defence that names attackers lists them
    under ``named`` in its state.

    Parameters
    ----------
    detector : Detector
    defenses : mapping of name to Defense
    extent : Extent
    seed : int
        Of attackers, attacks and draws.
    tick : callable
        Called after each frame of each setting.

    Returns
    -------
    list of Row
        For each setting: oracle, the defences, ego only.

    Raises
    ------
    FaultyDefense
        If a defence fails.
    """
    rows = [ORACLE, *defenses, EGO_ONLY]
    tallies = {(setting, name): _Tally() for setting in extent.settings for name in rows}
    for scene_seed in TEST_SEEDS[: extent.scenes]:
        scene = IntersectionScene(scene_seed)
        sensed = [_Sensed.of(detector, frame) for frame in scene.frames(extent.frames)]
        for setting in extent.settings:
            chosen = _attackers(scene, setting.attackers, seed)
            sequence = []
            for frame in _attacked(detector, sensed, chosen, setting, [seed, scene_seed]):
                sequence.append(frame)
                tick()
            _add_references(sequence, tallies[setting, ORACLE], tallies[setting, EGO_ONLY])
            for name, defense in defenses.items():
                rng = np.random.default_rng([seed, scene_seed, _stream(name)])
                _play(name, defense, sequence, chosen, tallies[setting, name], rng)
    return [tallies[setting, name].row(setting, name) for setting in extent.settings for name in rows]


def _stream(name: str) -> int:
    """A stream of random numbers of its own for each name."""
    return zlib.crc32(name.encode())


def _attackers(scene: IntersectionScene, count: int, seed: int) -> list[str]:
    """Of the scene's teammates; the same ones and more with a higher count."""
    team = sorted(set(scene.agents) - {EGO})
    order = np.random.default_rng([seed, scene.seed]).permutation(len(team))
    return [team[i] for i in order[:count]]


def _attacked(
    detector: Detector,
    sensed: Sequence[_Sensed],
    chosen: Sequence[str],
    setting: Setting,
    seed: Sequence[int],
) -> Iterator[CountedFrame]:
    campaign: Campaign = load_campaign(setting.campaign)
    rng = np.random.default_rng([*seed, _stream(setting.label)])
    for index, frame in enumerate(sensed):
        met = under_attack(detector, frame.messages, frame.truth, EGO, chosen, campaign, rng, index)
        yield CountedFrame(detector, met, frame.honest)


def _add_references(sequence: Sequence[CountedFrame], oracle: _Tally, ego_only: _Tally) -> None:
    for index, frame in enumerate(sequence):
        honest = [name for name in frame.met.received if name not in frame.met.attackers]
        oracle.add(index, frame, frame.detect(honest), honest, int(bool(honest)))
        ego_only.add(index, frame, frame.detect(), (), 0)


def _play(
    name: str,
    defense: Defense,
    sequence: Sequence[CountedFrame],
    chosen: Sequence[str],
    tally: _Tally,
    rng: np.random.Generator,
) -> None:
    """One sequence as a session, with the defence's memory."""
    team = sorted(sequence[0].met.received)
    state = defense.initial_state(team)
    previous: PreviousAnswer | None = None
    ever_named: set[str] = set()
    struck: int | None = None
    after: int | None = None
    for index, frame in enumerate(sequence):
        met = frame.met
        frame.passes = 0
        result = fuse(frame, defense, met.ego, met.received, rng=rng, state=state, frame=index, previous=previous)
        if result.fault is not None:
            raise FaultyDefense(f"{name}, frame {index}: {result.fault}")
        state, previous = result.state, result.previous
        tally.add(index, frame, result.boxes, result.accepted, frame.passes)
        tally.names |= "named" in state
        ever_named |= set(state.get("named", ()))
        if struck is None and met.attackers:
            struck = index
        if struck is not None and after is None and set(chosen) <= set(state.get("named", ())):
            after = index - struck + 1
    if struck is not None:
        tally.all_named_after.append(after)
    tally.honest_named += [teammate in ever_named for teammate in team if teammate not in chosen]
