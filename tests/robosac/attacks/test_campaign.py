from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from robosac.attacks import (
    ATTACKS,
    BEHAVIOURS,
    BIM,
    PGD,
    Campaign,
    GaussianNoise,
    IterativeAttack,
    Past,
    lacking,
    load_campaign,
)
from robosac.attacks.alibi import covering, framing
from robosac.attacks.campaign import always, asleep, drifting_pose, false_pose, flicker, turning_pose, turns
from robosac.boxes import from_world, pose_matrix
from robosac.evaluation.frames import Sensed, under_attack
from robosac.scenes import IntersectionScene

PAIR = ["car-2", "rsu"]


def acting(schedule, count, attackers=PAIR, **options):
    return [tuple(schedule(frame, attackers, **options)) for frame in range(count)]


def test_a_sleeper_wakes():
    assert acting(asleep, 4, frames=2) == [(), (), ("car-2", "rsu"), ("car-2", "rsu")]


def test_flickering_strikes_in_its_share_of_the_frames_without_a_rhythm():
    struck = [bool(names) for names in acting(flicker, 1000)]
    assert np.mean(struck) == pytest.approx(0.2, abs=0.04)
    gaps = np.diff(np.flatnonzero(struck))
    assert len(set(gaps)) > 8
    assert acting(flicker, 50) == acting(flicker, 50) != acting(flicker, 50, seed=1)


def test_attackers_take_turns():
    assert acting(turns, 6, frames=2) == [("car-2",), ("car-2",), ("rsu",), ("rsu",), ("car-2",), ("car-2",)]
    assert acting(turns, 1, []) == [()]
    assert acting(always, 1) == [("car-2", "rsu")]


def test_a_false_pose_moves_the_message_along_the_sender_axes():
    true = pose_matrix(10.0, 5.0, 1.7, np.pi / 2)
    claimed = false_pose(true, 0, forward_m=1.0, left_m=0.0, turn_deg=3.0)
    np.testing.assert_allclose(claimed[:3, 3], [10.0, 6.0, 1.7])
    turned = from_world(np.array([[0.0, 0.0, 4.0, 2.0, 0.0]]), claimed)[0, 4]
    assert turned == pytest.approx(-np.pi / 2 - np.radians(3.0))
    moved = np.linalg.norm(false_pose(true, 0)[:3, 3] - true[:3, 3])
    assert moved == pytest.approx(1.0)


def under(campaign, messages, detector, index=0, attackers=("car-2",), past=None):
    truth = IntersectionScene(seed=3).frame(0).truth("car-1")
    sensed = Sensed(index, "car-1", messages, truth)
    return under_attack(detector, sensed, attackers, campaign, np.random.default_rng(0), past)


def test_asleep_all_send_what_is_honest(detector, messages):
    third = partial(asleep, frames=3)
    met = under(Campaign(PGD(steps=1), third), messages, detector, index=2)
    assert not met.attackers
    assert all(met.teammates[name] is met.benign[name] for name in met.benign)
    awake = under(Campaign(PGD(steps=1), third), messages, detector, index=3)
    assert awake.attackers == {"car-2"}
    plain = under(PGD(steps=1), messages, detector)
    np.testing.assert_array_equal(
        awake.teammates["car-2"].tensors["features"], plain.teammates["car-2"].tensors["features"]
    )


@pytest.mark.parametrize(("pretence", "most"), [(turning_pose, (0.0, 3.0)), (drifting_pose, (1.2, 0.0))])
def test_a_pose_that_turns_or_drifts_begins_as_the_true_one(pretence, most):
    true = pose_matrix(3.0, -2.0, 1.7, 0.8)
    claimed = [np.linalg.inv(true) @ pretence(true, frame) for frame in range(40)]
    np.testing.assert_allclose(claimed[0], np.eye(4), atol=1e-12)
    left = [each[1, 3] for each in claimed]
    turned = [np.rad2deg(np.arctan2(each[1, 0], each[0, 0])) for each in claimed]
    for found, end in zip((left, turned), most, strict=True):
        steps = np.diff(found)
        assert (steps >= -1e-9).all()
        assert found[-1] == pytest.approx(end)
        assert steps.max(initial=0.0) < 0.2


def test_a_false_pose_needs_no_perturbation(detector, messages):
    met = under(load_campaign("honest@false-pose"), messages, detector)
    assert met.attackers == {"car-2"}
    assert met.teammates["car-2"].tensors is met.benign["car-2"].tensors
    np.testing.assert_allclose(met.teammates["car-2"].pose, false_pose(met.benign["car-2"].pose, 0))
    honest, lied = (detector.prepare(met.ego, sent).detect(["car-2"]) for sent in (met.benign, met.teammates))
    assert len(honest) != len(lied) or np.abs(honest - lied).max() > 0.1


def test_who_lies_about_nothing_is_no_attacker(detector, messages):
    met = under(load_campaign("honest"), messages, detector)
    assert not met.attackers
    assert met.teammates == met.benign


def test_an_attack_under_a_false_pose_is_optimised_for_it(detector, messages):
    met = under(load_campaign("pgd@false-pose"), messages, detector)
    assert not np.array_equal(met.teammates["car-2"].pose, met.benign["car-2"].pose)
    plain = under(PGD(), messages, detector).teammates["car-2"]
    assert not np.array_equal(met.teammates["car-2"].tensors["features"], plain.tensors["features"])


def test_who_covers_whom():
    assert covering(["a", "b", "c"], ["a", "b"]) == [["b", "c"], ["a", "c"], ["a"], ["b"]]
    assert covering(["a", "b", "c"], ["a"]) == []
    assert framing(["a", "b", "c"], ["a"]) == [["a", "c"], ["a"]]
    assert framing(["c", "b", "a"], ["b", "a"]) == [["b", "a"], ["a", "b"]]
    assert framing(["a"], ["a"]) == []


def logits(detector, met, team):
    surface = detector.attack_surface(met.ego, met.teammates)
    return surface.class_logits({name: surface.messages[name] for name in team})


@pytest.mark.parametrize(("behaviour", "attackers"), [("covering", ("car-2", "rsu")), ("framing", ("car-2",))])
def test_with_an_alibi_the_other_fusions_look_more_honest(behaviour, attackers, detector, messages):
    plain = under(BIM(), messages, detector, attackers=attackers)
    clever = under(load_campaign(f"bim@{behaviour}"), messages, detector, attackers=attackers)
    team = sorted(plain.benign)
    changes = {}
    for name, met in (("plain", plain), ("clever", clever)):
        for part in (tuple(team), *map(tuple, BEHAVIOURS[behaviour]["alibi"](team, attackers))):
            benign = detector.attack_surface(met.ego, met.benign)
            honest = benign.class_logits({member: benign.messages[member] for member in part})
            changes[name, part] = float((logits(detector, met, part) - honest).abs().mean())
    parts = [part for name, part in changes if name == "clever" and part != tuple(team)]
    assert all(changes["clever", part] < changes["plain", part] for part in parts)
    assert changes["clever", tuple(team)] > 0.2


def test_campaigns_by_name():
    assert load_campaign("erase") == Campaign(ATTACKS["erase"]())
    assert load_campaign("erase@asleep@false-pose") == Campaign(ATTACKS["erase"](), asleep, false_pose)
    assert load_campaign("robosac.attacks:PGD@turns") == Campaign(PGD(), turns)
    assert (load_campaign("honest").name, load_campaign("honest").epsilon) == ("honest", 0.0)
    assert (load_campaign("noise@flicker").name, load_campaign("pgd").epsilon) == ("noise", 0.5)
    campaign = load_campaign("pgd@asleep")
    assert Campaign.of(campaign) is campaign


@pytest.mark.parametrize(
    ("spec", "complaint"),
    [
        ("nonesuch@asleep", "no attack 'nonesuch'"),
        ("pgd@nonesuch", "unknown behaviour 'nonesuch'; known: asleep"),
        ("noise@framing", "only an attack that optimises"),
        ("pgd@framing@covering", "covering does not go with a behaviour before it: both set the alibi"),
        ("shift@soft@soft3", "soft3 does not go with .* both set the softness"),
        ("erase@asleep@flicker", "flicker does not go with .* both set the schedule"),
        ("honest@covering", "only an attack that optimises can have an alibi, not honest"),
    ],
)
def test_impossible_campaigns_are_explained(spec, complaint):
    with pytest.raises(ValueError, match=complaint):
        load_campaign(spec)
    with pytest.raises(ValueError, match="alibi"):
        Campaign(GaussianNoise(), alibi=covering)


def test_an_attacker_that_is_not_there_sends_nothing(detector, messages):
    met = under(load_campaign("honest@false-pose"), messages, detector, attackers=("nobody", "car-2"))
    assert met.attackers == {"car-2"}
    with pytest.raises(KeyError):
        load_campaign("honest@false-pose").messages(
            detector, met.ego, met.benign, ["nobody"], 0, np.random.default_rng(0)
        )


class Showing:
    """A detector whose attack surface has these methods only."""

    def __init__(self, detector, *shown):
        self.info, self.prepare, self.encode = detector.info, detector.prepare, detector.encode
        self.perturbed, self._detector, self._shown = detector.perturbed, detector, shown

    def attack_surface(self, ego, teammates):
        whole = self._detector.attack_surface(ego, teammates)
        return SimpleNamespace(messages=whole.messages, **{name: getattr(whole, name) for name in self._shown})


@pytest.mark.parametrize("spec", [*ATTACKS, "bim@framing"])
def test_what_an_attack_needs_is_enough_and_its_lack_is_said_before(spec, detector, messages):
    campaign = load_campaign(spec)
    if isinstance(campaign.attack, IterativeAttack):
        campaign = replace(campaign, attack=replace(campaign.attack, steps=1))
    enough = Showing(detector, *campaign.needs)
    assert lacking(campaign, enough) is None
    names = sorted(messages)
    others = {
        n: replace(messages[n], tensors=messages[o].tensors) for n, o in zip(names, names[1:] + names[:1], strict=True)
    }
    past = Past(foreign=lambda name, frame: messages["rsu"])
    under(campaign, others, enough, past=past)
    assert under(campaign, messages, enough, 1, past=past).attackers == {"car-2"}
    for part in campaign.needs:
        said = lacking(campaign, Showing(detector, *{*campaign.needs} - {part}))
        start = f"{campaign.name} cannot attack the detector intersection-mean: its attack surface lacks {part} ("
        assert said.startswith(start)


class Served:
    def __init__(self, detector):
        self.info, self.prepare = detector.info, detector.prepare


class Sensing(Served):
    def __init__(self, detector):
        super().__init__(detector)
        self.encode = detector.encode


def test_what_a_detector_lacks_for_a_scene_is_said_with_its_purpose(detector):
    assert lacking(None, Sensing(detector)) is None
    assert lacking(load_campaign("honest@false-pose"), Sensing(detector)) is None
    said = lacking(None, Served(detector))
    assert said == (
        "the detector intersection-mean cannot be used in scenes with the attack 'honest': "
        "it lacks encode (Make the message for a LiDAR scan.)"
    )
    said = lacking(PGD(), Sensing(detector))
    assert "with the attack 'pgd': it lacks attack_surface (Show a frame to an attacker.), perturbed (Put " in said


class Shaped:
    """A detector whose attack surface gives something in another form."""

    def __init__(self, detector, **given):
        self._detector, self._given = detector, given

    def attack_surface(self, ego, teammates):
        surface = self._detector.attack_surface(ego, teammates)
        found = {"messages": surface.messages, "class_logits": surface.class_logits, "perceive": surface.perceive}
        return SimpleNamespace(**{**found, **self._given})

    def __getattr__(self, name):
        return getattr(self._detector, name)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"messages": []}, "has messages that are no mapping of teammates to tensors, but a list"),
        ({"messages": {"a": np.zeros(3)}}, "has messages that must be tensors; that of 'a' is a ndarray"),
        ({"class_logits": lambda _: np.zeros(3)}, "has class_logits that must return a tensor, got a ndarray"),
    ],
)
def test_a_surface_of_another_form_is_told_before(detector, given, words):
    said = lacking(PGD(), Shaped(detector, **given))
    assert said == f"pgd cannot attack the detector intersection-mean: its attack surface {words}"
