import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from robosac.faults import MESSAGE_CHARS, describe, in_short, unreadable


@pytest.mark.parametrize(
    "message",
    [
        "expected (64, 32, 32), got (64, 32, 33)",
        "index 7 is out of bounds for axis 0 with size 5",
        "[Errno 2] No such file or directory: '/srv/gateway/detectors/intersection-mean-2.safetensors'",
        "mat1 and mat2 shapes cannot be multiplied (3x4 and 5x6) at 2026-11-21 20:12:24.135",
        "session 0f" + "a7" * 15 + " has ended",
    ],
)
def test_what_helps_is_kept(message):
    assert describe(RuntimeError(message)) == f"RuntimeError: {message}"


@pytest.mark.parametrize(
    "secret",
    [
        "eyJhbGciOiJIUzI1NiIsInR5cCI6IkpXVCJ9." + "eyJzdWIiOiJjYXIifQabcdefghijklmnopqrstuvw." + "s1G-" * 11,
        "ab" * 32,
        str(int("ab" * 32, 16)),
        str(np.linspace(0, 1, 50)),
        str(torch.linspace(0, 1, 50).reshape(2, 25)),
        repr(np.linspace(-1, 1, 9).tolist()),
        repr(np.linspace(0, 1, 50).astype("float16").tobytes()),
        "Could not decode to UTF-8 column 'value' with text '+z4jy\ufffdxt7t/k/qLfA='",
    ],
)
def test_what_belongs_in_no_log_is_not(secret):
    told = describe(ValueError(f"before {secret} after"))
    assert told.startswith("ValueError: before ")
    assert "<...>" in told
    assert len(told) < 80 + len("eyJhbGciOiJIUzI1NiIsInR5cCI6IkpXVCJ9.")


def test_a_long_message_is_cut():
    told = describe(RuntimeError("so it goes " * 10_000))
    assert MESSAGE_CHARS - 20 < len(told) <= MESSAGE_CHARS
    assert told.endswith("...")


@pytest.mark.parametrize("before", range(0, 2200, 5))
def test_a_message_is_not_cut_in_the_middle_of_a_key(before):
    key = "k3y.With~all+kinds/of-signs=="
    told = describe(RuntimeError("," * before + key + " and so on" * 500))
    assert "k3y" not in told or key in told


def test_an_exception_without_a_message_is_told_too():
    class Mute(Exception):
        def __str__(self):
            raise RuntimeError

    assert describe(Mute()) == "Mute: no message, for a RuntimeError"


@given(st.text(st.sampled_from("ab1.,- +[]\\x0"), max_size=600))
def test_what_is_short_stays(text):
    assert in_short(in_short(text)) == in_short(text)
    assert len(in_short(text)) <= MESSAGE_CHARS


def test_a_file_that_cannot_be_read_is_told_without_its_content(tmp_path):
    (tmp_path / "secret").write_bytes(b"a-secret-\xff")
    with pytest.raises(UnicodeError) as no_text:
        (tmp_path / "secret").read_text("utf-8")
    assert unreadable(no_text.value) == "it is no text"
    with pytest.raises(FileNotFoundError) as no_file:
        (tmp_path / "none").read_text()
    assert unreadable(no_file.value) == "No such file or directory"
    assert unreadable(OSError()) == "OSError"
