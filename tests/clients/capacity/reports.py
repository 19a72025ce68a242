"""Reports of load tests whose costs are known."""

import itertools
from typing import Any

ENGINE, LATENCY, CPU = (7.0, 0.8, 7.5), (25.0, 0.8, 8.0), (13.0, 1.6, 7.5)
STEPS = {(False, 3): {1: 100}, (True, 3): {1: 60, 2: 40}, (False, 5): {1: 100}, (True, 5): {1: 50, 2: 25, 3: 15, 5: 10}}


def cost(line: tuple[float, float, float], teammates: float, steps: float) -> float:
    return line[0] + line[1] * teammates + line[2] * steps


def a_load(loop: str, egos: int, attacked: bool, teammates: int) -> dict[str, Any]:
    counts = STEPS[attacked, teammates]
    frames = sum(counts.values())
    mean = sum(steps * count for steps, count in counts.items()) / frames
    return {
        "loop": loop,
        "egos": egos,
        "attacked": attacked,
        "rate_hz": 5.0 if loop == "open" else None,
        "teammates": teammates,
        "frames": frames,
        "fps": 5.0 * egos if loop == "open" else 30.0,
        "sampling_steps_mean": mean,
        "by_steps": {
            str(steps): {
                "frames": count,
                "engine_ms": cost(ENGINE, teammates, steps),
                "engine_spread_ms": 0.0,
                "latency_ms": cost(LATENCY, teammates, steps),
            }
            for steps, count in counts.items()
        },
        "used_a_frame": {
            "gateway_cpu_ms": cost(CPU, teammates, mean),
            "client_cpu_ms": 4.0,
            "disk_bytes": 2000.0,
            "sent_bytes": 131_000.0 * (1 + teammates),
            "received_bytes": 3000.0,
            "audit_bytes": 1500.0 + 100 * mean,
        },
        "stages_ms": {"receive": 6.0, "store": 4.0, "queue": 0.3},
        "errors": {},
    }


def a_report(teams: tuple[int, ...] = (3, 5), egos: tuple[int, ...] = (1, 4)) -> dict[str, Any]:
    kinds = itertools.product(teams, egos, ("closed", "open"), (False, True))
    return {
        "machine": {"cores": 2},
        "processes": 1,
        "defense": {"kind": "sample_consensus"},
        "loads": [a_load(loop, count, attacked, team) for team, count, loop, attacked in kinds],
    }
