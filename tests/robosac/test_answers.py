import json
import math

import numpy as np
import pytest
import rfc8785
from pydantic import ValidationError

from robosac import wire
from robosac.answers import Distrust, FrameAnswer, Reason, Source, Standing, Verdict
from robosac.audit import GENESIS, seal
from robosac.boxes import pose_matrix

FIELDS = {
    "frame": 3,
    "boxes": [[1.0, 2.5, 4.0, 2.0, 0.1, 0.9]],
    "support": [{"status": "repaired", "witnesses": ["ego", "b"], "deniers": []}],
    "contradicted": [
        {"status": "contradicted", "witnesses": ["b"], "deniers": ["ego"], "box": [9.5, 2.5, 4.0, 2.0, 0.1, 0.5]}
    ],
    "source": "consensus",
    "accepted": ["a", "b"],
    "rejected": [
        {"vehicle_id": "c", "reason": "dissensus", "hypotheses": [0], "lowest_jaccard_index": 0.125},
        {"vehicle_id": "d", "reason": "distrusted", "distrust": "named", "suspicion": 1.0, "evidence": [{"test": "e"}]},
        {"vehicle_id": "e", "reason": "missing"},
    ],
    "hypotheses": [{"teammates": ["a", "c"], "jaccard_index": 0.125, "verdict": "dissensus"}],
    "sampling_steps": 1,
    "attacker_ratio": None,
    "suspicion": {"a": 0.5},
    "deadline_met": True,
    "degraded_by": None,
    "timings_ms": {"total": 1.5},
}  # fmt: skip


def test_an_answer_reads_as_python_and_is_the_same_in_json_again():
    for read in (FrameAnswer.model_validate(FIELDS), FrameAnswer.model_validate_json(json.dumps(FIELDS), strict=True)):
        assert read.as_json() == FIELDS
        assert wire.unpack(wire.pack(read.as_json()), trusted=True) == FIELDS
        assert json.loads(read.model_dump_json()) == FIELDS
        assert (read.source, read.accepted) == (Source.CONSENSUS, ("a", "b"))
        assert read.boxes.dtype == np.float64
        assert read.boxes.tolist() == FIELDS["boxes"]
        assert read.hypotheses[0].verdict is Verdict.DISSENSUS
        assert list(read.rejected) == ["c", "d", "e"]
        assert read.rejected["c"].reason is Reason.DISSENSUS
        assert read.rejected["d"].distrust is Distrust.NAMED
        assert (read.rejected["c"].hypotheses, read.rejected["c"]["lowest_jaccard_index"]) == ([0], 0.125)
        assert read.named == ("d",)
        assert (read.support[0].status, read.support[0].witnesses) == (Standing.REPAIRED, ("ego", "b"))
        assert (read.contradicted[0].box[0], read.contradicted[0].deniers) == (9.5, ("ego",))
        with pytest.raises(KeyError):
            read.rejected["e"]["evidence"]


def test_what_a_later_version_adds_is_read_past():
    assert FrameAnswer.model_validate({**FIELDS, "weather": []}).as_json() == FIELDS


def test_what_a_defence_does_not_know_of_its_boxes_is_null_and_may_be_absent():
    unknown = {**FIELDS, "support": None, "contradicted": None}
    older = {name: value for name, value in FIELDS.items() if name not in ("support", "contradicted")}
    for fields in (unknown, older):
        assert FrameAnswer.model_validate(fields).as_json() == unknown


def test_a_frame_without_boxes_has_an_empty_array():
    assert FrameAnswer.model_validate({**FIELDS, "boxes": [], "support": None}).boxes.shape == (0, 6)


@pytest.mark.parametrize(
    "wrong",
    [
        {"boxes": [[1.0, 2.0]]},
        {"boxes": [["1"] * 6]},
        {"boxes": [[True] * 6]},
        {"boxes": None},
        {"boxes": [[1.0] * 6, [1.0]]},
        {"rejected": None},
        {"rejected": "c"},
        {"rejected": [{"vehicle_id": "c"}]},
        {"rejected": [{"vehicle_id": "c", "reason": "whim"}]},
        {"source": "hearsay"},
        {"frame": None},
        {"accepted": "ab"},
        {"hypotheses": [{}]},
    ],
)
def test_what_is_no_answer_is_refused(wrong):
    (name,) = wrong
    for read in (FrameAnswer.model_validate, lambda fields: FrameAnswer.model_validate_json(json.dumps(fields))):
        with pytest.raises(ValidationError) as refused:
            read({**FIELDS, **wrong})
        assert refused.value.errors()[0]["loc"][0] == name
    with pytest.raises(ValidationError):
        FrameAnswer.model_validate({key: value for key, value in FIELDS.items() if key != name})


@pytest.mark.parametrize(
    "wrong",
    [
        {"support": []},
        {"support": [{**FIELDS["support"][0], "status": "hearsay"}]},
        {"support": [{"status": "confirmed"}]},
        {"contradicted": FIELDS["support"]},
        {"contradicted": [{**FIELDS["contradicted"][0], "box": [1.0] * 5}]},
    ],
)
def test_what_is_no_support_is_refused(wrong):
    (name,) = wrong
    with pytest.raises(ValidationError) as refused:
        FrameAnswer.model_validate({**FIELDS, **wrong})
    assert refused.value.errors()[0]["loc"][0] == name


def test_a_number_that_json_does_not_have_is_not_changed_into_something_else():
    """Whoever writes it then fails, instead of keeping what was not answered."""
    changed = {"boxes": [[math.inf] * 6], "attacker_ratio": math.inf, "suspicion": {"a": math.inf}}
    answer = FrameAnswer.model_validate({**FIELDS, **changed})
    assert {name: answer.as_json()[name] for name in changed} == changed
    with pytest.raises(rfc8785.FloatDomainError):
        seal(answer.as_json(), "s", 1, GENESIS)


def test_boxes_are_turned_into_the_world_by_the_egos_pose():
    """The ego stands at (10, -3) and looks along +y: what it has ahead lies north of it."""
    answer, pose = FrameAnswer.model_validate(FIELDS), pose_matrix(10.0, -3.0, 1.7, np.pi / 2)
    np.testing.assert_allclose(answer.boxes_in_world(pose), [[7.5, -2.0, 4.0, 2.0, 0.1 + np.pi / 2, 0.9]])
    np.testing.assert_allclose(answer.contradicted_in_world(pose)[0, :2], [7.5, 6.5])
    np.testing.assert_array_equal(answer.boxes, FIELDS["boxes"])
    none = FrameAnswer.model_validate(FIELDS | {"contradicted": None, "boxes": [], "support": None})
    assert none.boxes_in_world(pose).shape == none.contradicted_in_world(pose).shape == (0, 6)


@pytest.mark.parametrize(
    ("pose", "complaint"),
    [(np.eye(3), "4 x 4"), (np.full((4, 4), np.nan), "finite"), (2 * np.eye(4), "must be a rigid transform")],
)
def test_boxes_are_turned_by_a_pose_only(pose, complaint):
    with pytest.raises(ValueError, match=f"a pose must be .*{complaint.removeprefix('must be ')}"):
        FrameAnswer.model_validate(FIELDS).boxes_in_world(pose)
