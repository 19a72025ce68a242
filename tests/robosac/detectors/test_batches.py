from itertools import chain, combinations
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from robosac.detectors import load
from robosac.detectors.base import Batching
from robosac.detectors.loading import warm_up
from robosac.detectors.map_fusion import WORTH
from tests.robosac.detectors.elsewhere import elsewhere


def subsets_of(team):
    return list(chain.from_iterable(combinations(team, size) for size in range(len(team) + 1)))


def check_same(prepared, others, subsets):
    """Sums are made in another order at once, so the last digits differ."""
    for boxes, subset in zip(prepared.detect_all(subsets), subsets, strict=True):
        np.testing.assert_allclose(boxes, others.detect(subset), atol=1e-4)


def test_subsets_decoded_at_once_give_what_each_gives(detector, ego_message, benign):
    prepared = detector.prepare(ego_message, benign)
    assert isinstance(prepared, Batching)
    check_same(prepared, prepared, subsets_of(benign))
    check_same(prepared, prepared, [("rsu", "car-2")])  # in another order than they were laid
    check_same(prepared, prepared, [("rsu",), (), ("rsu",)])


def test_they_do_so_there(detector, ego_message, benign):
    with elsewhere() as there:
        far = detector.on_device(there).prepare(ego_message, benign)
        assert far.worth == WORTH
        check_same(far, detector.prepare(ego_message, benign), subsets_of(benign))


def test_they_do_so_in_bfloat16(ego_message, benign):
    prepared = load("intersection-mean@bfloat16").prepare(ego_message, benign)
    subsets = [(), tuple(benign)]
    for boxes, subset in zip(prepared.detect_all(subsets), subsets, strict=True):
        np.testing.assert_allclose(boxes[:10], prepared.detect(subset)[:10], atol=0.1)


@pytest.mark.parametrize("there", [True, False])
def test_frames_of_several_egos_are_decoded_at_once(there, detector, messages):
    teams = {ego: {name: message for name, message in messages.items() if name != ego} for ego in ("car-1", "car-3")}
    with elsewhere() as device:
        far = detector.on_device(device if there else "cpu", worth=2)
        frames = {ego: far.prepare(messages[ego], team) for ego, team in teams.items()}
        assert {frame.family for frame in frames.values()} == {far}
        wanted = [(frames["car-1"], [("rsu",), ()]), (frames["car-3"], [("car-1", "rsu")]), (frames["car-1"], [()])]
        found = frames["car-3"].detect_together(wanted)
    assert [len(of_frame) for of_frame in found] == [2, 1, 1]
    here = {ego: detector.prepare(messages[ego], team) for ego, team in teams.items()}
    expected = [here["car-1"].detect(("rsu",)), here["car-1"].detect(()), here["car-3"].detect(("car-1", "rsu"))]
    for boxes, right in zip([*found[0], *found[1], *found[2]], [*expected, expected[1]], strict=True):
        np.testing.assert_allclose(boxes, right, atol=1e-4)


def test_who_is_added_later_is_fused_too(detector, ego_message, benign, attacked):
    prepared = detector.prepare(ego_message, {"car-3": benign["car-3"]})
    prepared.detect_all([("car-3",)])
    prepared.add({"car-2": benign["car-2"]})
    check_same(prepared, detector.prepare(ego_message, benign), [("car-2", "car-3"), ("car-2",)])
    prepared.add({"car-2": attacked["car-2"]})
    check_same(prepared, detector.prepare(ego_message, attacked), [("car-2", "car-3"), ("car-2",)])


def test_what_overflows_in_one_message_spoils_no_fusion_without_it(detector, ego_message, benign):
    prepared = detector.prepare(ego_message, benign)
    prepared.warped["car-2"] = torch.full_like(prepared.warped["car-2"], torch.inf)
    check_same(prepared, prepared, [("car-3", "rsu"), ()])


def test_an_unknown_teammate_is_an_error(detector, ego_message, benign):
    with pytest.raises(KeyError):
        detector.prepare(ego_message, benign).detect_all([(), ("car-9",)])


@pytest.mark.parametrize(("worth", "expected"), [(None, 1), (5, 5)])
def test_how_many_are_worth_it_can_be_chosen(worth, expected, detector, ego_message):
    assert detector.on_device("cpu", worth).prepare(ego_message, {}).worth == expected


@pytest.mark.parametrize("worth", [1, 5])
def test_a_warm_detector_has_decoded_as_many_at_once_as_it_will(worth, detector):
    decoded = []
    frame = SimpleNamespace(worth=worth, detect=lambda subset=(): np.zeros((0, 6)), detect_all=decoded.append)
    warm_up(SimpleNamespace(info=detector.info, prepare=lambda ego, others: frame))
    assert {len(subsets) for subsets in decoded} == set(range(2, worth + 1))


def test_a_warm_detector_has_decoded_passes_of_several_frames(detector):
    joined, alone = [], {"detect": lambda subset=(): np.zeros((0, 6)), "detect_all": list, "family": detector}
    frames = []

    def prepare(ego, others):
        frames.append(SimpleNamespace(worth=3, detect_together=joined.append, **alone))
        return frames[-1]

    warm_up(SimpleNamespace(info=detector.info, prepare=prepare))
    assert {sum(len(subsets) for _, subsets in wanted) for wanted in joined} == {2, 3, 4, 8, 16}
    assert all(one is not other for ((one, _), (other, _)) in joined)
