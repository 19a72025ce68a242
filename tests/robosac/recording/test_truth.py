import numpy as np
import pytest

from robosac import wire
from robosac.recording.truth import MOST_BOXES, Truth, read_truth

GOOD = Truth(np.arange(10.0).reshape(2, 5), ("car-2",)).as_fields()


def changed(**parts):
    return {**GOOD, **parts}


def boxes(**parts):
    return changed(boxes={**GOOD["boxes"], **parts})


def test_the_truth_travels_with_a_message(messages):
    body = wire.pack_message(4, "car-1", messages["car-1"], truth=GOOD)
    truth = read_truth(wire.read_message(body).payload)
    np.testing.assert_array_equal(truth.boxes, np.arange(10.0).reshape(2, 5))
    assert truth.attackers == ("car-2",)
    frame = wire.pack_frame(4, messages["car-1"], {}, truth=Truth(np.zeros((0, 5))).as_fields())
    assert read_truth(wire.read_frame(frame).ego, "ego").boxes.shape == (0, 5)


def test_a_message_need_not_tell_it(messages):
    assert read_truth(wire.read_message(wire.pack_message(0, "car-1", messages["car-1"])).payload) is None


@pytest.mark.parametrize(
    ("truth", "field", "code"),
    [
        ([], "ego.truth", "wrong-type"),
        ({}, "ego.truth.boxes", "wrong-type"),
        (boxes(dtype="float32"), "ego.truth.boxes.dtype", "wrong-dtype"),
        (boxes(shape=[2, 6]), "ego.truth.boxes.shape", "wrong-shape"),
        (boxes(shape=[True, 5]), "ego.truth.boxes.shape", "wrong-shape"),
        (boxes(shape=[-1, 5]), "ego.truth.boxes.shape", "out-of-range"),
        (boxes(shape=[MOST_BOXES + 1, 5]), "ego.truth.boxes.shape", "out-of-range"),
        (boxes(shape=[3, 5]), "ego.truth.boxes.data", "wrong-length"),
        (boxes(data="text"), "ego.truth.boxes.data", "wrong-length"),
        (boxes(data=np.zeros(10).tobytes()), "ego.truth.boxes.data", "out-of-range"),
        (boxes(data=np.full(10, np.nan).tobytes()), "ego.truth.boxes.data", "non-finite"),
        (changed(attackers="car-2"), "ego.truth.attackers", "wrong-type"),
        (changed(attackers=[5]), "ego.truth.attackers", "wrong-type"),
        (changed(attackers=["x" * 65]), "ego.truth.attackers", "out-of-range"),
        (changed(attackers=["car-2", "[/x]"]), "ego.truth.attackers", "out-of-range"),
        (changed(attackers=["\x1b[2J"]), "ego.truth.attackers", "out-of-range"),
        (changed(attackers=["car-2\n"]), "ego.truth.attackers", "out-of-range"),
    ],
)
def test_what_is_wrong_with_it_is_named(truth, field, code):
    with pytest.raises(wire.WireError) as refused:
        read_truth({"truth": truth}, "ego")
    assert (refused.value.field, refused.value.code) == (field, code)
