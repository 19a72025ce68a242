from copy import deepcopy

import pytest
import torch

from robosac.detectors import recorded
from robosac.detectors.recorded import EACH, MOST, Recorded, copies


class Playing:
    """A recording that is none: it computes again, with what it took."""

    def __init__(self, function, taken):
        self.function, self.taken = function, taken
        self.returned = tuple(torch.full_like(each, torch.nan) for each in function(*taken))

    def replay(self):
        for mine, each in zip(self.returned, self.function(*self.taken), strict=True):
            mine.copy_(each)


@pytest.fixture
def made(monkeypatch):
    """The rows of each recording that is made."""
    rows = []

    def record(self, taken):
        rows.append(tuple(len(each) for each in taken))
        graph = Playing(self._function, taken)
        return graph, taken, graph.returned

    monkeypatch.setattr(recorded, "can_record", lambda device: True)
    monkeypatch.setattr(Recorded, "_record", record)
    return rows


def twice(a, shared):
    return (2 * a + shared, a.sum(1))


@pytest.mark.parametrize("others", ["one for all", "one for each"])
def test_what_is_played_back_is_what_the_function_returns(others, made):
    played = Recorded(twice)
    for count in (1, 3, EACH, EACH + 1, MOST, MOST - 1, MOST + 1, 3, EACH + 2):
        a, shared = torch.randn(count, 4), torch.randn(1 if others == "one for all" else count, 4)
        results = played(a, shared)
        for mine, right in zip(results, twice(a, shared), strict=True):
            torch.testing.assert_close(mine, right, rtol=0, atol=0)
    sizes = [1, 3, EACH, MOST]
    assert made == [(size, 1 if others == "one for all" else size) for size in sizes]


def test_each_kind_of_arguments_has_a_recording(made):
    played = Recorded(twice)
    for dtype, width in ((torch.float32, 4), (torch.float16, 4), (torch.float32, 5), (torch.float32, 4)):
        a = torch.ones(2, width, dtype=dtype)
        assert (played(a, a[:1])[0] == 3).all()
    assert made == [(2, 1)] * 3


def test_a_copy_is_not_recorded_yet(made):
    played = Recorded(twice)
    played(torch.ones(2, 4), torch.ones(1, 4))
    deepcopy(played)(torch.ones(2, 4), torch.ones(1, 4))
    assert made == [(2, 1)] * 2


def test_on_the_processor_the_function_is_just_called():
    played = Recorded(twice)
    played(torch.ones(2, 4), torch.ones(1, 4))
    assert played._recordings == {}


def test_copies_hold_what_was_copied_in_its_type_and_layout():
    tensors = torch.rand(2, 3, 4, 5).contiguous(memory_format=torch.channels_last), torch.rand(3).half(), torch.rand(2)
    kept = [each.clone() for each in tensors]
    made = copies(tensors)
    for each in tensors:
        each.zero_()
    for copy, expected in zip(made, kept, strict=True):
        assert torch.equal(copy, expected)
        assert (copy.dtype, copy.stride()) == (expected.dtype, expected.stride())
