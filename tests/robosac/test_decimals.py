"""Many numbers as one text."""

import json

import numpy as np
import pytest

from robosac import decimals
from robosac.audit.replay import agree


@pytest.mark.parametrize("scale", [1.0, 3e8])
def test_numbers_come_back_as_rounded(rng, scale):
    values = scale * rng.normal(size=40)
    text = json.loads(json.dumps(decimals.as_text(values, 6)))
    assert decimals.is_text(text)
    np.testing.assert_allclose(decimals.from_text(text), values.round(6), rtol=0, atol=1e-6 if scale > 1 else 0)
    assert decimals.as_text(decimals.from_text(text), 6) == text
    assert decimals.from_text(decimals.as_text(np.zeros(0), 6)).shape == (0,)


@pytest.mark.parametrize(
    "text",
    [
        None,
        5,
        "",
        "decimals:",
        "decimals:7:i4",
        "decimals:x:i4:",
        "decimals:99:i4:",
        "decimals:7:f8:",
        "decimals:7:i4:A",
    ],
)
def test_other_texts_are_refused(text):
    with pytest.raises(ValueError, match="decimals"):
        decimals.from_text(text)


def test_a_text_of_half_a_number_is_refused():
    with pytest.raises(ValueError, match="multiple"):
        decimals.from_text("decimals:7:i4:AAA=")


def test_a_replay_takes_them_as_numbers():
    values = np.array([0.25, 1.5e-7, 0.0])
    logged, near, far = (decimals.as_text(values + off, 7) for off in (0.0, 2e-7, 1e-4))
    assert [agree({"table": logged}, {"table": text}) for text in (logged, near, far)] == [True, True, False]
    assert not agree(logged, decimals.as_text(values[:2], 7))
    assert not agree(logged, "else")
