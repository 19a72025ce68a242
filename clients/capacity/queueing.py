r"""Waiting times, in closed form.

Times are in one unit, rates in its inverse. :math:`\lambda` is the rate of arrivals, :math:`S` a service time,
:math:`\rho = \lambda E[S] / c` the share of the time that each of :math:`c` servers is busy, :math:`W` the wait before
service begins. Arrivals are Poisson. Frames of many vehicles that each keep a period are a little more even than that,
so that these formulas err on the safe side.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from scipy.optimize import brentq
from scipy.stats import poisson


@dataclass(frozen=True)
class Service:
    """A service time: its mean, and its mean square."""

    mean: float
    square: float

    @property
    def variation(self) -> float:
        """Squared coefficient of variation: 0 if all take the same time, 1 if exponential."""
        return self.square / self.mean**2 - 1


def one_server_wait(rate: float, service: Service) -> float:
    r"""The mean wait for one server, M/G/1: :math:`E[W] = \lambda E[S^2] / (2 (1 - \rho))` (Pollaczek and Khinchine).

    Source: L. Kleinrock, Queueing Systems, volume 1, 1975, equation 5.62. Infinite where :math:`\rho \geq 1`.
    """
    busy = rate * service.mean
    return rate * service.square / (2 * (1 - busy)) if busy < 1 else math.inf


def erlang_c(servers: int, load: float) -> float:
    r"""The share of arrivals that have to wait, M/M/c, for a load of :math:`a = \lambda E[S]`.

    :math:`C = \frac{B}{1 - (a / c)(1 - B)}` with Erlang's loss formula :math:`B = P(N = c) / P(N \leq c)` of a Poisson
    number with mean :math:`a`. Source: R. B. Cooper, Introduction to Queueing Theory, 2nd edition, 1981, section 3.5.
    It is 1 where :math:`a \geq c`.
    """
    if load >= servers:
        return 1.0
    loss = math.exp(poisson.logpmf(servers, load) - poisson.logcdf(servers, load))
    return loss / (1 - load / servers * (1 - loss))


def pool_wait(rate: float, service: Service, servers: int) -> float:
    r"""About the mean wait for any of several servers, M/G/c.

    :math:`E[W] \approx \frac{C E[S]}{c - a} \cdot \frac{1 + \mathrm{scv}}{2}`: that of M/M/c, less where service times
    vary less (A. M. Lee and P. A. Longton, Operational Research Quarterly 10, 1959). Exact for one server; for M/D/c
    it is half of M/M/c. Infinite where :math:`a \geq c`.
    """
    load = rate * service.mean
    if load >= servers:
        return math.inf
    return erlang_c(servers, load) * service.mean / (servers - load) * (1 + service.variation) / 2


def waits_longer(time: float, waits: float, mean_wait: float) -> float:
    r"""About the share of arrivals that wait longer than a time: :math:`P(W > t) \approx p e^{-p t / E[W]}`.

    :math:`p` is the share that waits at all: :math:`\rho` for one server, Erlang's C for several. The tail of the wait
    is about exponential (J. F. C. Kingman, Proceedings of the Cambridge Philosophical Society 57, 1961), and this one
    has the right mean. Exact for M/M/c; for constant service times up to twice what it is.
    """
    if math.isinf(mean_wait):
        return 1.0
    return waits * math.exp(-waits * time / mean_wait) if mean_wait > 0 else 0.0


def one_server_late(rate: float, service: Service, patience: float) -> float:
    """About the share of arrivals at one server that wait longer than their patience."""
    return waits_longer(patience, min(1.0, rate * service.mean), one_server_wait(rate, service))


def pool_late(rate: float, service: Service, servers: int, patience: float) -> float:
    """About the share of arrivals at several servers that wait longer than their patience."""
    return waits_longer(patience, erlang_c(servers, rate * service.mean), pool_wait(rate, service, servers))


def most_rate(service: Service, patience: float, late: float, busy: float) -> float:
    """The highest rate at which one server is no busier, and no larger a share waits beyond its patience, than this."""
    highest = busy / service.mean
    if one_server_late(highest, service, patience) <= late:
        return highest
    return float(brentq(lambda rate: one_server_late(rate, service, patience) - late, 0.0, highest))


def most_mean(most: float, exceeding: float) -> float:
    r"""The highest mean of parties that fall on a place by chance, so that few places have more than ``most``.

    Where many parties are hashed to many places, a place has a Poisson number of them: the largest mean with
    :math:`P(N > \mathrm{most}) \leq \mathrm{exceeding}` (M. Mitzenmacher and E. Upfal, Probability and Computing, 2005,
    section 5.4). 0 where less than one fits.
    """
    whole = math.floor(most)
    if whole < 1:
        return 0.0
    return float(brentq(lambda mean: poisson.sf(whole, mean) - exceeding, 1e-9, most + 1))


def closed_rate(customers: int, demands: Sequence[float], delay: float = 0.0) -> float:
    r"""The rate at which so many customers go round a closed network of single servers, exact MVA.

    For :math:`n = 1, 2, ...`: the time at station k is :math:`R_k = D_k (1 + Q_k)`, with the queues of one customer
    less; the rate is :math:`X = n / (Z + \sum_k R_k)`, the queues :math:`Q_k = X R_k`. :math:`Z` is the time spent
    outside (``delay``). Source: M. Reiser and S. S. Lavenberg, Journal of the ACM 27, 1980.

    Parameters
    ----------
    customers : int
    demands : sequence of float
        Time that a round takes at each station, without waiting.
    delay : float
    """
    queues, rate = [0.0] * len(demands), 0.0
    for number in range(1, customers + 1):
        times = [demand * (1 + queue) for demand, queue in zip(demands, queues, strict=True)]
        rate = number / (delay + math.fsum(times))
        queues = [rate * time for time in times]
    return rate
