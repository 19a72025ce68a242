import json
import math
import subprocess
import sys

import msgpack
import pytest

from clients.adversary import RECOVERED_WITHIN, Result, Seen
from clients.hostile import STRANGERS, Attack, strange_frame
from clients.load_test import EGO, TEAM
from robosac import wire
from robosac.session import Session


def test_two_attacks_are_played_and_told(tmp_path):
    """As a command, since its attacker is a process of its own."""
    attacks = [Attack.LONG, Attack.DATABASE]
    only = [word for attack in attacks for word in ("--only", attack.value)]
    command = [sys.executable, "-m", "clients.adversary", "--seconds", "2", "--out", str(tmp_path), *only]
    done = subprocess.run([*command, "--budget-ms", "1000"], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    for attack in attacks:
        assert attack.value in done.stdout
    long, locked = json.loads((tmp_path / "adversary.json").read_text())
    for part in (long["before"], long["during"], locked["before"]):
        assert part["frames"] == 10
        assert part["tested"] >= 8
    assert locked["during"]["frames"] == 10
    assert locked["recovered_after"] <= RECOVERED_WITHIN
    for result in (long, locked):
        assert result["before"]["belied"] == result["during"]["belied"] == 0
        assert 50 < result["memory_mib"] < 4000


@pytest.mark.parametrize(
    ("belied", "recovered", "attack", "held"),
    [
        (0, 0, Attack.DATABASE, True),
        (0, RECOVERED_WITHIN + 1, Attack.DATABASE, False),
        (0, None, Attack.DATABASE, False),
        (0, None, Attack.LONG, True),
        (1, 0, Attack.LONG, False),
    ],
)
def test_what_does_not_hold_is_told(belied, recovered, attack, held):
    during = Seen(200.0, frames=10, belied=belied)
    assert Result(attack, Seen(200.0), during, {}, math.nan, recovered).held is held


def test_frames_until_one_is_good_are_counted_in_the_order_in_which_they_were_due():
    seen = Seen(200.0, outcomes=[(1.0, True), (4.0, True), (2.0, False), (3.0, False)])
    assert [seen.recovered_after(moment) for moment in (0.5, 1.5, 4.0, 5.0)] == [0, 2, 0, None]


def test_whoever_measures_leaves_the_gateway_cores_of_its_own():
    said = "from clients.cores import Cores; import os, sys; cores = Cores(); all = os.sched_getaffinity(0)\n"
    said += "with cores.of_gateways(): theirs = os.sched_getaffinity(0)\n"
    said += "ours = os.sched_getaffinity(0)\n"
    said += "sys.exit(not (theirs | ours == all and (len(all) == 1 or not theirs & ours)))"
    assert subprocess.run([sys.executable, "-c", said], check=False).returncode == 0


def test_a_strange_frame_contradicts_the_ego_and_passes_what_is_looked_at_before(detector, messages):
    honest = wire.pack_frame(0, messages[EGO], {name: messages[name] for name in TEAM})
    frame = wire.read_frame(strange_frame(honest))
    team = {name: wire.check_message(payload, detector.info, "teammate") for name, payload in frame.teammates.items()}
    assert len(team) == STRANGERS
    assert frame.frame == msgpack.unpackb(honest)["frame"]
    answer = Session(detector, list(team)).answer(0, messages[EGO], team)
    assert len(answer.rejected) > STRANGERS // 2  # some may agree with the ego by chance
    assert answer.sampling_steps > 0
