import math

import numpy as np
import pytest

from clients.capacity import queueing
from clients.capacity.queueing import Service

EXPONENTIAL, CONSTANT = Service(1.0, 2.0), Service(1.0, 1.0)


def waits(rate: float, services: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Of each arrival at one server, by Lindley's recursion."""
    gaps, wait, found = rng.exponential(1 / rate, len(services)), 0.0, []
    for gap, service in zip(gaps, services, strict=True):
        found.append(wait)
        wait = max(0.0, wait + service - gap)
    return np.array(found)


def test_one_server_waits_as_in_the_textbook():
    assert queueing.one_server_wait(0.8, EXPONENTIAL) == pytest.approx(0.8 / 0.2)  # M/M/1: rho / (mu - lambda)
    assert queueing.one_server_wait(0.8, CONSTANT) == pytest.approx(2.0)  # M/D/1: half of it
    assert math.isinf(queueing.one_server_wait(1.0, CONSTANT))


@pytest.mark.parametrize(("servers", "load", "share"), [(1, 0.7, 0.7), (2, 1.0, 1 / 3), (10, 8.0, 0.4092), (3, 5.0, 1)])
def test_erlangs_c(servers, load, share):
    assert queueing.erlang_c(servers, load) == pytest.approx(share, abs=1e-4)


def test_a_pool_of_one_is_one_server_and_constant_services_halve_the_wait():
    mixed = Service(2.0, 7.0)
    assert queueing.pool_wait(0.3, mixed, 1) == pytest.approx(queueing.one_server_wait(0.3, mixed))
    assert queueing.pool_wait(6.0, CONSTANT, 8) == pytest.approx(queueing.pool_wait(6.0, EXPONENTIAL, 8) / 2)
    assert queueing.pool_wait(6.0, EXPONENTIAL, 8) == pytest.approx(queueing.erlang_c(8, 6.0) / 2)  # M/M/c: C / (c - a)
    assert math.isinf(queueing.pool_wait(8.0, EXPONENTIAL, 8))
    assert queueing.pool_late(6.0, CONSTANT, 8, 1.0) < queueing.one_server_late(6.0 / 8, CONSTANT, 1.0)


@pytest.mark.parametrize("busy", [0.5, 0.8])
@pytest.mark.parametrize("kind", ["exponential", "constant", "mixed"])
def test_the_tail_is_near_what_a_simulation_finds(kind, busy):
    rng, number = np.random.default_rng(3), 200_000
    services = {
        "exponential": rng.exponential(1.0, number),
        "constant": np.ones(number),
        "mixed": rng.choice([0.8, 2.8], number, p=[0.9, 0.1]),
    }[kind]
    found = waits(busy, services, rng)
    service = Service(float(services.mean()), float((services**2).mean()))
    assert queueing.one_server_wait(busy, service) == pytest.approx(found.mean(), rel=0.1)
    for late in (0.1, 0.01):
        time = float(np.quantile(found, 1 - late))
        told = queueing.one_server_late(busy, service, time)
        if kind == "exponential":
            assert told == pytest.approx(late, rel=0.15)
        else:  # on the safe side
            assert 0.8 * late < told < 2.2 * late


def test_the_highest_rate_keeps_both_bounds():
    patience, late = 4.0, 0.01
    rate = queueing.most_rate(CONSTANT, patience, late, 0.95)
    assert queueing.one_server_late(rate, CONSTANT, patience) == pytest.approx(late)
    assert queueing.most_rate(CONSTANT, 1000.0, late, 0.7) == pytest.approx(0.7)


def test_few_places_get_more_than_they_can_take():
    mean = queueing.most_mean(9, 0.01)
    counts = np.bincount(np.random.default_rng(0).integers(20_000, size=int(20_000 * mean)), minlength=20_000)
    assert (counts > 9).mean() == pytest.approx(0.01, abs=0.003)
    assert mean < 9
    assert queueing.most_mean(0.9, 0.01) == 0.0


def test_a_closed_network_is_that_of_the_textbook():
    assert queueing.closed_rate(1, [2.0, 3.0], 5.0) == pytest.approx(1 / 10)
    assert queueing.closed_rate(200, [2.0, 3.0], 5.0) == pytest.approx(1 / 3, rel=1e-6)  # the slowest station
    for number in (1, 2, 5):  # balanced: X = N / (D (N + K - 1))
        assert queueing.closed_rate(number, [2.0, 2.0, 2.0]) == pytest.approx(number / (2.0 * (number + 2)))
