"""Plays all scenes of a comparison, in one process or several, and sums them up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from multiprocessing import get_context
from multiprocessing.sharedctypes import Synchronized

import torch

from robosac.evaluation.comparison import kept
from robosac.evaluation.comparison.playing import ORACLE, Plan, PlayedScene, play_scene
from robosac.evaluation.comparison.rows import Row, precisions, sum_up
from robosac.scenes import Scene

_POLL_S = 0.5


def compare_defenses(plan: Plan, jobs: int = 1, tick: Callable[[], None] = lambda: None) -> list[Row]:
    """Every defence in every setting. ``tick`` is called after each frame of each setting.

    The rows of a defence depend neither on the other defences, nor on the other settings, nor on the number of jobs.

    Parameters
    ----------
    plan : Plan
    jobs : int
        Processes that share the scenes; with more than one, detector and defences must be such that can be pickled.

    Returns
    -------
    list of Row
        For each setting: oracle, the defences, ego only.

    Raises
    ------
    FaultyDefense
        If a defence fails.
    robosac.scenes.SceneError
        As `Plan.scenes`.
    """
    (rows,) = compare_plans([plan], jobs, tick)
    return rows


def compare_plans(plans: Sequence[Plan], jobs: int = 1, tick: Callable[[], None] = lambda: None) -> list[list[Row]]:
    """Several comparisons, each as `compare_defenses` makes it; the processes share the scenes of all."""
    scenes = [plan.scenes() for plan in plans]
    if jobs == 1:
        played = [
            [_sequence(plan, number, scene, tick) for number, scene in enumerate(each)]
            for plan, each in zip(plans, scenes, strict=True)
        ]
    else:
        played = _in_processes(plans, [len(each) for each in scenes], jobs, tick)
    return [_rows(plan, each) for plan, each in zip(plans, played, strict=True)]


def _sequence(plan: Plan, number: int, scene: Scene, tick: Callable[[], None]) -> PlayedScene:
    """One sequence of a plan, played now or earlier."""
    if plan.kept is None:
        return play_scene(plan, scene, tick)
    played = kept.load(plan.kept, number)
    if played is None:
        played = play_scene(plan, scene, tick)
        kept.keep(plan.kept, number, played)
    else:
        for _ in range(len(plan.extent.settings) * plan.extent.frames):
            tick()
    return played


def _rows(plan: Plan, scenes: Sequence[PlayedScene]) -> list[Row]:
    rows = []
    for setting in plan.extent.settings:
        oracle = precisions([scene[setting, ORACLE] for scene in scenes])
        for name in plan.rows:
            rows.append(sum_up(setting, name, [scene[setting, name] for scene in scenes], oracle, plan.live))
    return rows


def _in_processes(
    plans: Sequence[Plan], scenes: Sequence[int], jobs: int, tick: Callable[[], None]
) -> list[list[PlayedScene]]:
    # forked from one that has imported all and done nothing: a process with threads (of the progress bar, of torch)
    # must not be forked, and one that is spawned imports torch for itself
    context = get_context("forkserver")
    context.set_forkserver_preload([__name__])
    done: Synchronized[int] = context.Value("L", 0)
    told = 0
    with ProcessPoolExecutor(min(jobs, sum(scenes)), context, _begin, (plans, done)) as pool:
        asked = [[pool.submit(_play_scene, which, number) for number in range(n)] for which, n in enumerate(scenes)]
        futures = [future for each in asked for future in each]
        try:
            while wait(futures, _POLL_S, FIRST_EXCEPTION).not_done:
                told = _tell(tick, told, done.value)
                for future in futures:
                    if future.done():
                        future.result()
        finally:
            pool.shutdown(cancel_futures=True)
    _tell(tick, told, done.value)
    return [[future.result() for future in each] for each in asked]


def _tell(tick: Callable[[], None], told: int, done: int) -> int:
    for _ in range(done - told):
        tick()
    return done


_worker: tuple[Sequence[Plan], Synchronized[int]] | None = None
"""In a worker process, what it was begun with: a shared counter cannot be sent along with a scene."""


def _begin(plans: Sequence[Plan], done: Synchronized[int]) -> None:
    global _worker  # noqa: PLW0603
    torch.set_num_threads(1)
    _worker = plans, done


def _play_scene(which: int, number: int) -> PlayedScene:
    if _worker is None:
        raise RuntimeError("only in a process of the pool")
    plans, done = _worker

    def tick() -> None:
        with done.get_lock():
            done.value += 1

    return _sequence(plans[which], number, plans[which].scenes()[number], tick)
