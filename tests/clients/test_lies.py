import io

import numpy as np
import pytest
from rich.console import Console

from clients.fleet import FleetOptions, run_fleet
from clients.lies import Lies
from clients.local_gateway import local_gateway
from clients.simulation import EgoFrame
from robosac.answers import Distrust, FrameAnswer, Reason, RejectedTeammate, Source
from robosac.attacks import Lie
from robosac.detectors import Message

GHOST = np.array([12.0, 3.0, 4.5, 1.9, 0.0])
TRUTH = np.array([[0.0, 9.0, 4.5, 1.9, 0.0]])
WITH, WITHOUT = np.array([[*GHOST, 0.9], [*TRUTH[0], 0.8]]), np.array([[*TRUTH[0], 0.8]])
NOBODY = Message(np.eye(4), {})


class Decoded:
    """A frame of which only the honest fusion is asked for."""

    def detect(self, teammates=()):
        assert teammates == ["honest"]
        return WITHOUT


def frame(lies=(Lie("ghost", GHOST),), attackers=("liar",)):
    sent = dict.fromkeys(("honest", "liar"), NOBODY)
    return EgoFrame(0, "ego", frozenset(attackers), sent, sent, NOBODY, TRUTH, np.empty((0, 3)), tuple(lies))


def answer(number, boxes, named=()):
    rejected = [RejectedTeammate(vehicle_id=n, reason=Reason.DISTRUSTED, distrust=Distrust.NAMED) for n in named]
    return FrameAnswer(
        frame=number,
        boxes=boxes,
        source=Source.CONSENSUS,
        accepted=(),
        rejected=rejected,
        hypotheses=(),
        sampling_steps=0,
        attacker_ratio=None,
        deadline_met=True,
        degraded_by=None,
        timings_ms={},
    )


def test_lies_are_counted_over_the_frames_of_each_ego():
    lies = Lies()
    lies.add(frame((), ()), answer(0, WITHOUT), Decoded(), WITHOUT)
    lies.add(frame(), answer(1, WITH), Decoded(), WITH)
    lies.add(frame(), answer(2, WITH), Decoded(), WITH)
    lies.add(frame(), answer(3, WITHOUT, ["liar"]), Decoded(), WITH)
    rates = lies.as_dict()
    assert (rates["object_frames"], rates["held"], rates["longest"]) == (3, pytest.approx(2 / 3), 2)
    assert (rates["sequences_shown"], rates["shown_named"], rates["frames_to_name"]) == (1, 1, 3.0)
    assert lies.sentence() == (
        "Lies about single objects: told in 66.7% of 3 object frames, at most 2 in a row; all attackers named in 1 of "
        "1 sequences in which one shows, after 3.0 frames on average."
    )


def test_whoever_is_named_besides_names_no_attacker():
    lies = Lies()
    lies.add(frame(), answer(0, WITH, ["honest"]), Decoded(), WITH)
    assert lies.as_dict()["shown_named"] == 0
    assert lies.sentence().endswith("all attackers named in 0 of 1 sequences in which one shows.")


def test_without_lies_there_is_nothing_to_say():
    lies = Lies()
    lies.add(frame(()), answer(0, WITH), Decoded(), WITH)
    assert (lies.as_dict(), lies.sentence()) == (None, None)


async def test_a_fleet_says_what_became_of_a_ghost(tmp_path, monkeypatch):
    monkeypatch.setenv("ROBOSAC_GATHER_MS", "10000")  # a busy machine does not decide who is heard
    console = Console(file=io.StringIO(), width=200)
    async with local_gateway(tmp_path / "gateway.log") as url:
        options = FleetOptions(url, 1, 3, 2, attack="ghost", defense={"kind": "none"}, budget_ms=20_000.0)
        summary = await run_fleet(options, console)
    rates = summary.as_dict()["objects"]
    assert rates["object_frames"] == 3
    assert rates["held"] > 0.5
    summary.print(console)
    assert "Lies about single objects: told in" in " ".join(console.file.getvalue().split())
