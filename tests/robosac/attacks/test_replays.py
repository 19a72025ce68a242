"""Replays that have something to pretend."""

import numpy as np
import pytest
import torch

from robosac.attacks import BEHAVIOURS, Copy, Frozen, Situation, load_campaign, words
from robosac.attacks.alibi import covering
from robosac.calibrated import witness_of
from robosac.consensus import at_least
from robosac.defenses import EGO
from robosac.defenses.group_testing.claims import Claims
from robosac.defenses.group_testing.geometry import measure
from tests.robosac.attacks.linear import Linear, situation

SENDER = "car-3"
ROUNDING = 0.01
"""Of messages, which are half floats."""


def features(message):
    return message.tensors["features"].astype(np.float64)


def logits(detector, met, messages):
    surface = detector.attack_surface(met.ego, messages)
    return surface.class_logits(surface.messages)


@pytest.mark.parametrize(("spec", "bound"), [("copy@soft", 0.5), ("copy@soft@double", 1.0), ("copy@denying", 0.5)])
def test_a_soft_replay_keeps_within_the_bound_around_the_replayed_map(spec, bound, played):
    for met in played(spec, 2):
        changed = np.abs(features(met.teammates[SENDER]) - features(met.benign["car-4"]))
        assert 0.8 * bound < changed.max() < bound + ROUNDING


def figures(detector, frames):
    """Means over frames of g + v beside the ego alone, and of how strange the attacker's word is where boxes show."""
    pairs, strange, witness = [], [], witness_of(detector.info)
    for met in frames:
        prepared = met.prepare(met.ego, met.teammates)
        pair = measure(at_least(prepared.detect(()), detector.info.consensus_score), prepared.detect([SENDER]))
        pairs.append(pair.loss + pair.novelty)
        boxes = at_least(prepared.detect(met.team), detector.info.consensus_score)[:, :5]
        own, honest = (
            Claims.of(boxes, witness.testify(EGO, {EGO: met.ego, SENDER: sent[SENDER]})).likelihood[1]
            for sent in (met.teammates, met.benign)
        )
        strange.append(np.abs(own - honest).mean())
    return np.mean(pairs), np.mean(strange)


def test_a_soft_replay_shows_less_in_what_is_measured(detector, played):
    plain, soft, denying = (figures(detector, played(spec, 2)) for spec in ("copy", "copy@soft", "copy@denying"))
    assert soft[0] < plain[0] - 1
    assert denying[1] < 0.5 * min(plain[1], soft[1])


def test_the_harm_of_a_soft_replay_stays(detector, played):
    for plain, soft in zip(played("copy", 2), played("copy@soft", 2), strict=True):
        honest, wanted, found = (
            torch.sigmoid(logits(detector, met, messages))
            for met, messages in ((plain, plain.benign), (plain, plain.teammates), (soft, soft.teammates))
        )
        harmed = (wanted - honest).abs() > 0.3
        assert harmed.any()
        assert (found - wanted)[harmed].abs().mean() < 0.5 * (honest - wanted)[harmed].abs().mean()


def test_a_soft_replay_begins_with_what_the_frame_before_ended_with():
    surface = Linear()
    surface.bends = 0.02
    for warm in (False, True):
        met, attack = situation(surface, memory={}), Copy(steps=1, step_size=0.04)
        sent = [attack.optimise(surface, ["a"], np.random.default_rng(0), met, [pull], warm) for _ in range(2)]
        moved = [float((each["a"] - surface.messages["b"]).abs().max()) for each in sent]
        assert moved == pytest.approx([0.04, 0.08 if warm else 0.04])


def pull(sent):
    """A term that wants messages smaller than anything else does."""
    return 1e3 * sum(tensor.sum() for tensor in sent.values())


def test_who_has_nothing_to_replay_is_honest_though_soft(played):
    (first,) = played("frozen@soft", 1)
    assert not first.attackers
    assert Frozen().optimise(Linear(), ["a"], np.random.default_rng(0), Situation()) == {}


def test_without_a_pretence_a_replay_is_the_map_itself(played):
    for spec in ("copy", "copy@asleep@false-pose"):
        assert (campaign := load_campaign(spec)).needs == ()
        assert campaign.attack == Copy()
    met, _ = played("copy", 2)
    np.testing.assert_array_equal(met.teammates[SENDER].tensors["features"], met.benign["car-4"].tensors["features"])


def test_what_only_a_replay_shows_is_spoken_of_honestly():
    surface = Linear()
    surface.messages["b"] = surface.messages["b"].clone()
    surface.messages["b"][2, 3] = 9.0 - surface.ego[2, 3]
    surface.messages["c"] = surface.messages["c"].clone()
    surface.messages["c"][2, 3] = -9.0
    honest, replayed = {"a": surface.messages["a"]}, {"a": surface.messages["b"]}
    kept = []
    for attack in (None, Copy()):
        met = situation(surface, truth=np.empty((0, 5)))
        if attack is not None:
            attack.aim(surface, ["a"], met)
        kept.append(words.Speech.of(met, surface, ["a"], []).kept)
        assert words.denying(met, surface, honest).item() == 0.0
        assert words.denying(met, surface, replayed).item() > 0.0
    assert len(kept[1]) > len(kept[0])


def test_replaying_attackers_can_have_an_alibi(detector, played):
    pair = ("car-3", "rsu")
    assert BEHAVIOURS["covering"]["alibi"] is covering
    off = {}
    for spec in ("copy", "copy@covering"):
        (met,) = played(spec, 1, pair)
        alone = [logits(detector, met, {name: sent[name] for name in pair[:1]}) for sent in (met.benign, met.teammates)]
        off[spec] = float((alone[0].sigmoid() - alone[1].sigmoid()).abs().mean())
    assert off["copy@covering"] < off["copy"]
