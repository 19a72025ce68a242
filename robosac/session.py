"""An ego's perception over time: a detector, a defence that remembers, and the answer before."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from robosac.ahead import Ahead
from robosac.arguments import check_deadline, check_frame, check_rng, check_session, check_team, checked_number
from robosac.calibrated import calibration_of, screening_for
from robosac.deadline import Deadline
from robosac.defenses import Defense, DefenseSettings, SampleConsensus, State, build
from robosac.defenses.group_testing import GroupTestingSettings
from robosac.detectors import Detector, DetectorInfo, Message, Preparer
from robosac.fusion import FrameRun, FusionResult
from robosac.previous import PreviousAnswer
from robosac.screening import FRAME_PERIOD_S, Screening, joined, separated
from robosac.steps import Steps, finished
from robosac.verified import first_state, state_of_team


def default_defense(info: DetectorInfo) -> DefenseSettings:
    """The defence where none is asked for: group testing if the detector is calibrated for it, else sampling."""
    return GroupTestingSettings() if info.calibration is not None else SampleConsensus()


def defense_for(settings: DefenseSettings | Mapping[str, Any], info: DetectorInfo) -> Defense:
    """A defence of these settings, with the calibration of a detector where it needs one.

    Raises
    ------
    robosac.budget.DomainError
        As `robosac.defenses.build`.
    """
    return build(settings, lambda: calibration_of(info))


def changed_team(defense: Defense, state: State, team: Sequence[str]) -> State:
    """A session's state after teammates joined or left; ``team`` is the new one.

    Raises
    ------
    robosac.budget.DomainError
        If the defence's settings make no sense for it, it fails, or an id cannot be one.
    """
    check_team(team)
    alone, memory = separated(state)
    return joined(state_of_team(defense, alone, team), memory)


class Session:
    """Answers frame after frame, and remembers between them what the defence knows and what was answered last.

    Parameters
    ----------
    detector : Preparer
        Any `Detector`.
    team : sequence of str
        All teammates, present or not: texts, none empty and none twice.
    defense : Defense, optional
        By default `default_defense` of the detector, which then must be a whole `Detector`.
    saved : mapping, optional
        What `save` gave: the session goes on from there, with the team that it had.
    rng : numpy.random.Generator, optional
        All randomness of the defence; seeded by the operating system by default, so that nobody can foresee it.
    screening : Screening, optional
        Tests of messages before any of them is fused; by default those that the detector is calibrated for, at the
        period of frames that the defence is for. None for no such tests.

    Raises
    ------
    TypeError, ValueError
        If an argument is none of these, a teammate is named twice, or another defence saved what is to go on.

    Attributes
    ----------
    state : mapping
        What the defence and the tests of messages remember, JSON values.
    previous : PreviousAnswer or None
        The latest answer, if anybody was fused into it.

    Raises
    ------
    robosac.budget.DomainError
        If the id of a teammate cannot be one, or the defence fails to say what it remembers at first.

    Examples
    --------
    >>> import robosac
    >>> detector = robosac.load_detector()
    >>> scene = robosac.IntersectionScene(seed=8)
    >>> session = robosac.Session(detector, [name for name in scene.agents if name != "car-1"])
    >>> for number in range(2):
    ...     views = scene.frame(number).views
    ...     messages = {name: detector.encode(view.points, view.pose) for name, view in views.items()}
    ...     answer = session.answer(number, messages.pop("car-1"), messages)
    >>> answer.named
    ()
    """

    def __init__(
        self,
        detector: Preparer,
        team: Sequence[str],
        defense: Defense | None = None,
        saved: Mapping[str, Any] | None = None,
        rng: np.random.Generator | None = None,
        screening: Screening | Literal["calibrated"] | None = "calibrated",
    ) -> None:
        check_session(team, defense, saved, rng, screening)
        self.detector = detector
        self.defense = defense or _default(detector)
        period_s = _period_s(self.defense)
        self.screening = screening_for(detector.info, period_s) if screening == "calibrated" else screening
        kind = None if saved is None else saved.get("defense")  # a log tells it elsewhere
        if kind not in (None, self.defense.kind):
            raise ValueError(f"saved by a session of the defence {kind}, this one has {self.defense.kind}")
        self._rng = rng or np.random.default_rng()
        self.state: State = first_state(self.defense, team) if saved is None else saved["state"]
        before = None if saved is None else saved.get("previous")
        self.previous = None if before is None else PreviousAnswer.from_json(before)

    def answer(
        self,
        frame: int,
        ego: Message,
        teammates: Mapping[str, Message],
        deadline: Deadline | None = None,
        detector: Preparer | None = None,
    ) -> FusionResult:
        """Decide a frame, and remember it for the next.

        Parameters
        ----------
        frame : int
            Its number; frames of successive numbers are one frame period apart.
        ego : Message
        teammates : mapping of teammate id to Message
            As `robosac.fuse` takes them. Who is not in the team joins it, and is remembered until `change_team`.
        deadline : Deadline, optional
            By default there is time for all.
        detector : Preparer, optional
            What decodes this frame in the place of the session's detector, such as a recording, or a
            `robosac.ahead.Ahead` in which the frame was begun.

        Raises
        ------
        TypeError, ValueError
            If the frame is no integer, or a message is none or not of the detector's layout.
        """
        result = self.decide(frame, ego, teammates, self._rng, deadline, detector)
        self.remember(result)
        return result

    def decide(
        self,
        frame: int,
        ego: Message,
        teammates: Mapping[str, Message],
        rng: np.random.Generator,
        deadline: Deadline | None = None,
        detector: Preparer | None = None,
    ) -> FusionResult:
        """Decide as `answer` does, but remember nothing yet: for a caller that has to store the decision first.

        The draws come from ``rng``.
        """
        return finished(self.decide_in_steps(frame, ego, teammates, rng, deadline, detector))

    def decide_in_steps(
        self,
        frame: int,
        ego: Message,
        teammates: Mapping[str, Message],
        rng: np.random.Generator,
        deadline: Deadline | None = None,
        detector: Preparer | None = None,
    ) -> Steps[FusionResult]:
        """Decide as `decide` does, but pause before each pass, so that the work of others can take turns with it."""
        frame = checked_number(frame)
        check_rng(rng)
        check_deadline(deadline)
        check_frame((detector or self.detector).info, ego, teammates)
        deadline = deadline or Deadline()
        if isinstance(detector, Ahead):
            deadline.expect(detector.pass_s)
        run = FrameRun(detector or self.detector, self.defense, ego, frame, self.previous, deadline, self.screening)
        return run.answer(teammates, rng, self.state)

    def remember(self, result: FusionResult) -> None:
        """Let a decision count for the next frame."""
        self.state, self.previous = result.state, result.previous

    def change_team(self, team: Sequence[str]) -> None:
        """Teammates joined or left; ``team`` is the new one.

        Raises
        ------
        robosac.budget.DomainError
            If the defence's settings make no sense for it, or an id cannot be one.
        """
        self.state = changed_team(self.defense, self.state, team)

    def save(self) -> dict[str, Any]:
        """What the session remembers, JSON values: with it, another one goes on from here.

        The generator of the draws is not part of it: whoever knew it could foresee them.
        """
        previous = None if self.previous is None else self.previous.as_json()
        return {"defense": self.defense.kind, "state": dict(self.state), "previous": previous}


def _period_s(defense: Defense) -> float:
    """Time from frame to frame, where a defence was told."""
    told: float | None = getattr(getattr(defense, "settings", None), "frame_period_ms", None)
    return FRAME_PERIOD_S if told is None else told / 1e3


def _default(detector: Preparer) -> Defense:
    if not isinstance(detector, Detector):
        raise TypeError(f"{type(detector).__name__} is no whole detector: say which defence to take")
    return defense_for(default_defense(detector.info), detector.info)
