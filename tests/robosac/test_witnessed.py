"""The witness beside a detector's weights: found, of this detector, and part of what a decision follows from."""

import hashlib
import json
import os
import shutil
from dataclasses import replace

import numpy as np
import pytest

from robosac.calibrated import calibration_digest, calibration_of, witness_of
from robosac.deadline import Deadline, Recorded
from robosac.defenses import EGO
from robosac.defenses.group_testing import GroupTestingSettings
from robosac.defenses.group_testing.model import LIE
from robosac.detectors import EmbeddedDetector, Message
from robosac.detectors.embedded import SHIPPED_WEIGHTS
from robosac.detectors.weights_file import WeightsError
from robosac.detectors.witness import AT_ONCE
from robosac.fusion import fuse


@pytest.fixture
def copied(tmp_path):
    """The shipped detector somewhere else, with what lies beside its weights."""
    for path in SHIPPED_WEIGHTS.parent.glob(f"{SHIPPED_WEIGHTS.stem}.*"):
        shutil.copy(path, tmp_path)
    return tmp_path / SHIPPED_WEIGHTS.name


def test_the_shipped_detector_has_a_witness(detector):
    witness = witness_of(detector.info)
    assert witness is witness_of(detector.info)  # read once
    assert calibration_of(detector.info).witnessed


def test_without_a_witness_objects_are_not_judged(copied, ego_message, benign):
    copied.with_suffix(".witness.safetensors").unlink()
    bare = EmbeddedDetector(copied)
    assert (bare.info.witness, witness_of(bare.info)) == (None, None)
    calibration = calibration_of(bare.info)
    assert not calibration.witnessed
    defense = GroupTestingSettings().build(calibration)
    assert (defense.asks_witnesses, LIE in defense.model.kinds) == (False, False)
    result = fuse(bare, defense, ego_message, benign, rng=np.random.default_rng(0))
    assert (result.fault, result.objects) == (None, None)
    assert result.hypotheses[0].testimony is None


def test_with_a_witness_all_outcomes_of_a_frame_have_its_testimony(detector, ego_message, benign):
    defense = GroupTestingSettings().build(calibration_of(detector.info))
    assert defense.asks_witnesses
    result = fuse(detector, defense, ego_message, benign, rng=np.random.default_rng(0))
    (testimony,) = {id(o.testimony): o.testimony for o in result.hypotheses}.values()
    assert testimony.agents == (EGO, *benign)
    expected = witness_of(detector.info).testify(EGO, {EGO: ego_message, **benign})
    np.testing.assert_array_equal(testimony.maps, expected.maps)
    assert result.timings_ms["testimony"] > 0
    assert len(result.objects) == len(result.boxes)
    asked = GroupTestingSettings(judge_objects=False).build(calibration_of(detector.info))
    unheard = fuse(detector, asked, ego_message, benign, rng=np.random.default_rng(0))
    assert unheard.hypotheses[0].testimony is None
    assert unheard.objects is None


def test_an_ego_that_sees_little_is_asked_only_about_that(detector, ego_message, benign):
    """It keeps nobody out for showing what it cannot see."""
    (name, features), *_ = ego_message.tensors.items()
    half_blind = features.copy()
    half_blind[:, :, :20] = 0
    ego = Message(ego_message.pose, {name: half_blind})

    def answered(judge_objects):
        defense = GroupTestingSettings(judge_objects=judge_objects).build(calibration_of(detector.info))
        return fuse(detector, defense, ego, benign, rng=np.random.default_rng(0))

    asked, unasked = answered(judge_objects=True), answered(judge_objects=False)
    assert set(asked.accepted) == set(benign)
    assert len(unasked.accepted) < len(benign)
    whole = [tested for tested in asked.hypotheses if len(tested.teammates) == len(benign)]
    assert [tested.verdict for tested in whole] == ["consensus"]


def test_the_ego_alone_is_told_with_every_outcome(detector, ego_message, benign):
    defense = GroupTestingSettings().build(calibration_of(detector.info))
    result = fuse(detector, defense, ego_message, benign, rng=np.random.default_rng(0), frame=4)
    alone = detector.prepare(ego_message, {}).detect()
    assert all(o.frame == 4 and np.array_equal(o.alone, alone) for o in result.hypotheses)


def test_a_witness_of_other_weights_is_refused(copied):
    info = EmbeddedDetector(copied).info
    with pytest.raises(WeightsError, match=r"make it anew \(robosac witness\)"):
        witness_of(replace(info, weights_digest="0" * 64))
    assert witness_of(info) is not None  # not remembered as refused


def test_a_changed_witness_is_read_again(copied):
    info = EmbeddedDetector(copied).info
    assert witness_of(info) is witness_of(info)
    info.witness.write_bytes(info.witness.read_bytes()[:-8])
    os.utime(info.witness, ns=(1, 1))
    with pytest.raises(WeightsError, match="not a readable"):
        witness_of(info)


def test_the_digest_of_a_calibration_covers_the_witness(copied):
    info = EmbeddedDetector(copied).info
    both = calibration_digest(info)
    assert both == hashlib.sha256(info.calibration.read_bytes() + info.witness.read_bytes()).hexdigest()
    assert calibration_digest(replace(info, witness=None)) == hashlib.sha256(info.calibration.read_bytes()).hexdigest()
    info.calibration.write_text(json.dumps(json.loads(info.calibration.read_text())) + "\n\n")
    os.utime(info.calibration, ns=(1, 1))
    assert calibration_digest(info) != both
    info.witness.unlink()
    assert calibration_digest(info) is None
    assert calibration_digest(replace(info, calibration=None)) is None


def test_messages_that_there_is_no_time_to_read_are_told(detector, ego_message, benign):
    """And the decision can be made again from what it tells."""
    names = [f"v{i}" for i in range(AT_ONCE + 2)]
    sent = {name: list(benign.values())[i % len(benign)] for i, name in enumerate(names)}
    defense = GroupTestingSettings().build(calibration_of(detector.info))

    def decided(deadline):
        result = fuse(detector, defense, ego_message, sent, rng=np.random.default_rng(0), deadline=deadline)
        assert result.fault is None
        return result

    hasty = decided(Hasty())
    assert hasty.unread == hasty.answer(0, {}, {}).unread == tuple(names[AT_ONCE - 1 :])
    again = decided(Recorded(None, hasty.unread))
    assert again.unread == hasty.unread
    assert again.state == hasty.state
    whole = decided(None)
    assert whole.unread == ()
    assert "unread" not in whole.answer(0, {}, {}).as_json()


class Hasty(Deadline):
    """There is time to read one group of messages."""

    def reading(self, share):
        groups = iter([True, False])
        return lambda _: next(groups)
