"""What attackers hear, and what they make their own messages say."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from robosac.attacks import PGD, Campaign, Hearing, Lie, NoWitness, Situation, lacking, load_campaign, words
from robosac.boxes import pairwise_iou
from robosac.calibrated import witness_of
from robosac.defenses import EGO
from robosac.defenses.group_testing.claims import DENIES, SUPPORTS, Claims
from robosac.detectors.base import DetectorInfo
from robosac.testimony import MOST
from tests.robosac.attacks.linear import VEHICLES, Linear, hearing, situation


@pytest.fixture(scope="module")
def heard(detector, ego_message, benign):
    """A real frame: what an attacker hears of it, and what the defence does."""
    surface = detector.attack_surface(ego_message, benign)
    poses = {name: message.pose for name, message in benign.items()}
    ours = Hearing.of(detector.info, ego_message, surface.messages, poses)
    theirs = witness_of(detector.info).testify(EGO, {EGO: ego_message, **benign})
    return ours, theirs, surface


@pytest.fixture
def boxes(scene_frame):
    free = np.random.default_rng(0).uniform(-30, 30, (40, 5)) * [1, 1, 0, 0, 0.1] + [0, 0, 4.5, 1.9, 0]
    return np.vstack([scene_frame.truth("car-1")[:, :5], free])


def test_an_attacker_hears_what_the_defence_hears(heard, boxes):
    ours, theirs, surface = heard
    np.testing.assert_allclose(ours.benign.maps, theirs.maps, rtol=1e-3, atol=1e-4)  # half floats
    now = ours.hear(surface.messages)
    measured = Claims.of(boxes, theirs.of(surface.messages)).likelihood
    said = now.likelihood(torch.from_numpy(boxes).float()).numpy()
    assert np.abs(measured).max() == pytest.approx(MOST)
    np.testing.assert_allclose(said, measured, atol=0.02)
    seen = theirs.of(surface.messages).sighting(boxes[:, :2]).centre
    apart = np.abs(now.centres(torch.from_numpy(boxes[:, :2]).float()).numpy() - seen)
    assert np.quantile(apart, 0.99) < 0.02  # places at the edge of a cell may fall into the next one


def test_what_is_clipped_can_still_be_changed():
    surface = Linear()
    message = {"a": torch.full((3, 4), -9.0, requires_grad=True)}
    said = hearing(surface).hear(message).likelihood(torch.tensor([[3.0, 5.0, 4.5, 1.9, 0.0]]))
    assert said.item() == pytest.approx(-MOST)
    (gradient,) = torch.autograd.grad(said.sum(), message["a"])
    assert gradient.sum() > 1.0


def told(surface, lies, **changes):
    return situation(surface, lies=lies, **changes)


def saying(surface, name, places, level):
    """A message of a sender that says so much more around the cells of some places (x, y)."""
    message = surface.messages[name].clone()
    for x, y in places:
        column, row = int((x + 40) / 20), int((y + 40) / (80 / 3))
        message[row, column] += level
    return {name: message}


GHOST = Lie("ghost", np.array([-25.0, -25.0, 4.5, 1.9, 0.0]))
ERASED = Lie("erased", VEHICLES[0])


@pytest.mark.parametrize(
    ("style", "lie", "sign"),
    [
        (words.denying, GHOST, -1),
        (words.vouching, GHOST, 1),
        (words.denying, ERASED, 1),
        (words.vouching, ERASED, -1),
    ],
)
def test_what_is_paid_is_the_word_that_is_not_as_it_should_be(style, lie, sign):
    surface = Linear()

    def paid(level):
        at = [lie.box[:2] + [dx, dy] for dx in (-15, 0, 15) for dy in (-20, 0, 20)] if lie is GHOST else [lie.box[:2]]
        return style(told(surface, [lie]), surface, saying(surface, "a", at, level)).item()

    assert paid(sign * 0.7) < paid(0.0) < paid(-sign * 0.7)


def test_honest_messages_pay_for_nothing_but_the_lie_and_strange_ones_do():
    surface = Linear()
    honest = {"a": surface.messages["a"]}
    for style in (words.denying, words.vouching):
        assert style(told(surface, []), surface, honest).item() == 0.0
        strange = saying(surface, "a", [VEHICLES[0, :2]], -0.5)
        assert style(told(surface, []), surface, strange).item() > 0.2


def test_a_vehicle_where_the_ghost_stands_is_not_denied():
    surface, lie = Linear(), Lie("ghost", VEHICLES[0] + [0.5, 0, 0, 0, 0])
    assert words.denying(told(surface, [lie]), surface, {"a": surface.messages["a"]}).item() == 0.0


def test_who_vouches_for_a_moved_vehicle_sees_it_where_it_is_said_to_be():
    surface = Linear()
    middle = np.array([10.0, 0.0])  # of a cell, where a's message sees all vehicles of that cell
    paid = []
    for off in (0.0, 1.2):
        box = np.array([*(middle + [0.0, off]), 4.5, 1.9, 0.0])
        lie = Lie("moved", box, truth=box - [0, 1.2, 0, 0, 0])
        met = told(surface, [lie], truth=np.empty((0, 5)))
        paid.append(words.vouching(met, surface, saying(surface, "a", [middle], 1.0)).item())
    assert paid[1] - paid[0] == pytest.approx(1.2, abs=0.05)


def own_words(detector, frames, attackers):
    """Of each lie in each frame: L of the attackers' own messages there, and whether the undefended fusion tells it."""
    witness = witness_of(detector.info)
    for met in frames:
        said = witness.testify(EGO, {EGO: met.ego, **met.teammates}).of(attackers)
        fused = met.prepare(met.ego, met.teammates).detect(met.team)
        fused = fused[fused[:, 5] >= 0.3]
        assert met.lies
        for lie in met.lies:
            at = lie.truth if lie.kind == "moved" else lie.box
            near = np.hypot(*(fused[:, :2] - lie.box[:2]).T)
            shows = near.min() < 1.0 if lie.kind != "erased" else pairwise_iou(lie.box[None], fused).max() < 0.3
            yield Claims.of(at[None, :5], said).likelihood[:, 0], shows


@pytest.mark.parametrize(
    ("spec", "attackers", "sign"),
    [
        ("ghost@denying", ("car-3",), -1),
        ("remove@denying", ("car-3", "rsu"), 1),
        ("displace@denying", ("car-3",), 1),
        ("ghost@vouching", ("car-3", "rsu"), 1),
        ("remove@vouching", ("car-3",), -1),
    ],
)
def test_their_own_word_is_as_wanted_and_the_lie_still_shows(spec, attackers, sign, detector, played):
    found = list(own_words(detector, played(spec, 1, attackers), attackers))
    for everybody, _ in found:
        said = everybody[everybody != 0.0]  # the place may lie beyond the map of one of them
        assert len(said)
        assert (said >= SUPPORTS).all() if sign > 0 else (said <= DENIES).all()
    assert np.mean([shows for _, shows in found]) > 0.5


def test_an_attack_on_whole_fusions_says_honestly_what_is_there(detector, played):
    witness, strange = witness_of(detector.info), {}
    for spec in ("shift@soft", "shift@denying"):
        strange[spec] = []
        for met in played(spec, 1):
            own, honest = (
                Claims.of(met.truth[:, :5], witness.testify(EGO, {EGO: met.ego, "car-3": sent["car-3"]})).likelihood[1]
                for sent in (met.teammates, met.benign)
            )
            strange[spec].append(np.abs(own - honest).mean())
    assert np.mean(strange["shift@denying"]) < 0.5 * np.mean(strange["shift@soft"])


def test_a_campaign_with_words_is_soft_and_says_what_it_lacks(detector):
    campaign = load_campaign("shift@vouching")
    assert (campaign.softness, campaign.words, campaign.remembers, campaign.hears) == (1.0, words.vouching, True, True)
    assert not load_campaign("shift@soft").hears
    with pytest.raises(ValueError, match="soft pays for words"):
        Campaign(PGD(), words=words.denying)
    with pytest.raises(ValueError, match="can be soft, not noise"):
        load_campaign("noise@denying")
    with pytest.raises(NoWitness, match="robosac witness"):
        words.denying(Situation(), Linear(), {})
    assert lacking(campaign, detector) is None
    bare = Unwitnessed(detector)
    said = lacking(campaign, bare)
    assert said.startswith("shift cannot attack the detector intersection-mean: it reads testimony")
    assert Hearing.of(bare.info, None, {}, {}) is None


class Unwitnessed:
    """A detector without a witness."""

    def __init__(self, detector):
        self.info: DetectorInfo = replace(detector.info, witness=None)
        self.prepare, self.encode = detector.prepare, detector.encode
        self.attack_surface, self.perturbed = detector.attack_surface, detector.perturbed
