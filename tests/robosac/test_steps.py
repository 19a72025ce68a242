import time

import pytest

from robosac.steps import done_within, finished


def steps(count, result="done"):
    yield from range(count)
    return result


def test_work_is_finished_without_a_pause():
    assert finished(steps(3)) == "done"


def test_work_goes_on_until_the_time_is_over():
    work, times = steps(3, None), 0
    while (read := done_within(work, 0.0)) is None:
        times += 1
    assert (read, times) == ((None,), 3)
    assert done_within(steps(10_000), 60.0) == ("done",)


def test_time_is_looked_at_after_each_step():
    def slow():
        while True:
            time.sleep(0.02)
            yield

    began = time.perf_counter()
    assert done_within(slow(), 0.05) is None
    assert time.perf_counter() - began >= 0.05


def test_what_goes_wrong_is_told():
    def wrong():
        yield
        raise ValueError("wrong")

    with pytest.raises(ValueError, match="wrong"):
        done_within(wrong(), 60.0)
