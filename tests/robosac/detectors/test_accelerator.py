"""What only an accelerator shows. The other tests put a device in its place that is none; see `elsewhere`."""

from copy import deepcopy

import numpy as np
import pytest
import torch

from robosac import Session
from robosac.calibrated import witness_of
from robosac.detectors import load
from robosac.detectors.decoding import boxes_there
from robosac.detectors.loading import warm_up
from robosac.detectors.recorded import Recorded
from tests.robosac.detectors.alike import check_alike, subsets_of

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no accelerator")


@pytest.fixture(scope="module")
def far():
    detector = load(device="cuda")
    warm_up(detector)
    return detector


def test_a_recording_gives_what_its_function_gives_for_every_shape():
    def function(a, b):
        return (torch.relu(a @ b).sum(1), a + 1)

    recorded = Recorded(function)
    for size in (3, 5, 3):
        a, b = torch.randn(size, 4, device="cuda"), torch.randn(4, 6, device="cuda")
        for mine, right in zip(recorded(a, b), function(a, b), strict=True):
            torch.testing.assert_close(mine, right)
    assert len(recorded._recordings) == 2
    assert deepcopy(recorded)._recordings == {}


def test_the_embedded_detector_sees_there_what_it_sees_here(far, detector, ego_message, attacked):
    prepared, here = far.prepare(ego_message, attacked), detector.prepare(ego_message, attacked)
    subsets = subsets_of(attacked)
    for size in (1, 2, far.worth, len(subsets)):
        for subset, boxes in zip(subsets, prepared.detect_all(subsets[:size]), strict=False):
            check_alike(boxes, here.detect(subset))
    check_alike(prepared.detect(subsets[-1]), here.detect(subsets[-1]))


def test_played_back_or_not_the_same_boxes_are_found(far, ego_message, benign):
    prepared, subsets = far.prepare(ego_message, benign), subsets_of(benign)[: far.worth]
    first = prepared.detect_all(subsets)
    with torch.inference_mode():
        unrecorded = boxes_there(far._found_there(prepared._fused_for(subsets)))
    for boxes, again, computed in zip(first, prepared.detect_all(subsets), unrecorded, strict=True):
        np.testing.assert_array_equal(boxes, again)
        check_alike(computed, boxes)


def test_a_placed_detector_can_be_placed_again(far, detector, ego_message, benign):
    subset = list(benign)
    near, here = far.on_device("cpu").prepare(ego_message, benign), detector.prepare(ego_message, benign)
    np.testing.assert_array_equal(near.detect(subset), here.detect(subset))


def test_a_witness_hears_there_what_it_hears_here(far, detector, ego_message, benign):
    messages = {"ego": ego_message, **benign}
    for count in (1, 3, len(messages), 3):
        some = dict(list(messages.items())[:count])
        said, expected = (witness_of(each.info).testify("ego", some).maps for each in (far, detector))
        np.testing.assert_allclose(said, expected, atol=0.1)
        assert np.abs(said - expected).mean() < 1e-3


def test_a_session_decides_there_as_it_does_here(far, detector, ego_message, attacked):
    answers = []
    for each in (far, detector):
        session = Session(each, sorted(attacked), rng=np.random.default_rng(0))
        answers.append([session.answer(frame, ego_message, attacked) for frame in range(4)])
    for there, here in zip(*answers, strict=True):
        assert (there.accepted, set(there.rejected)) == (here.accepted, set(here.rejected))
        check_alike(there.boxes, here.boxes)
