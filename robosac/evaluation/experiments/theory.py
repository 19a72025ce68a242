"""Experiments on the law of sampling: the derivation, the numerical figures, the estimated attacker ratio."""

from __future__ import annotations

from typing import Any

import numpy as np

from robosac.budget import attackers_in_team, clean_probability, eq1_collaborators, eq2_budget
from robosac.defenses import A2CP, SampleConsensus, State
from robosac.evaluation.experiments import paper
from robosac.evaluation.experiments.common import TEAM_SIZE, Context
from robosac.evaluation.frames import DecodedOnce
from robosac.evaluation.oracle import converse_with_oracle, simulate_sampling
from robosac.evaluation.report import Section, Table
from robosac.figures import new_figure, save_figure
from robosac.session import Session

MOST_STEPS = 500
NEVER = MOST_STEPS + 1
MOST_FRAMES = 200
RATIOS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)


def derivation(context: Context) -> Section:
    """Table 1: steps until consensus, and how often Eq. 2's budget suffices."""
    steps_rows, success_rows = [], []
    for number, (eta, s, n, paper_steps, paper_success) in enumerate(paper.TABLE_1):
        attackers = attackers_in_team(TEAM_SIZE, eta)
        defense = SampleConsensus.independent(attacker_ratio=eta, sampling_budget=MOST_STEPS, collaborators=s)
        oracle = simulate_sampling(defense, TEAM_SIZE, attackers, context.scale.oracle_runs, context.rng(3, number))
        q = clean_probability(TEAM_SIZE, attackers, s)
        steps = _steps_until_consensus(context, defense, attackers, number)
        mean, never = until_consensus(steps)
        means = (1 / q, oracle.mean(), mean)
        shares = (1 - (1 - q) ** n, (oracle <= n).mean(), (steps <= n).mean())
        rounded = (None if v is None else round(float(v), 2) for v in means)
        steps_rows.append((eta, s, paper_steps, *rounded, round(never, 3)))
        success_rows.append((eta, s, n, paper_success, *(round(float(value), 3) for value in shares)))
    sources = ("paper", "exact", "oracle", "detector")
    return Section(
        "Validation of the derivation",
        "Draws as in the paper, independent from step to step. *Exact* is the hypergeometric law; *oracle* a verdict "
        "that is never wrong; *detector* the consensus test on test frames under PGD. The detector takes longer where "
        "an honest subset is refused, and less where an attacked one passes. Where the ego and every subset disagree "
        f"there is no consensus however long one draws; such runs, given up after {MOST_STEPS} steps, are the last "
        "column and not in the mean.",
        [
            Table(
                "derivation_steps",
                "Mean steps until a consensus",
                ("eta", "s", *sources, "detector: never"),
                steps_rows,
            ),
            Table(
                "derivation_success",
                "Share of frames with a consensus within the N of Eq. 2",
                ("eta", "s", "N", *sources),
                success_rows,
            ),
        ],
    )


def until_consensus(steps: np.ndarray[Any, np.dtype[np.int64]]) -> tuple[float | None, float]:
    """Mean of the steps (n,) of those runs that came to a consensus, and the share of those that never did."""
    agreed = steps < NEVER
    return float(steps[agreed].mean()) if agreed.any() else None, float(1 - agreed.mean())


def _steps_until_consensus(
    context: Context, defense: SampleConsensus, attackers: int, number: int
) -> np.ndarray[Any, np.dtype[np.int64]]:
    steps = [
        result.sampling_steps if result.accepted else NEVER
        for index, frame in enumerate(context.frames(attackers, scenes=max(1, context.scale.scenes // 4)))
        for result in frame.answers(defense, [context.seed, 4, number, index], context.scale.repeats)
    ]
    return np.array(steps, dtype=np.int64)


def numerical(context: Context) -> Section:
    """The numerical figures: s over N and N over s."""
    budgets, sizes = range(1, 26), range(1, 11)
    figure = new_figure(11, 4.2)
    left, right = figure.subplots(1, 2)
    for eta in RATIOS:
        left.plot(budgets, [eq1_collaborators(n, eta) for n in budgets], marker=".", label=f"eta = {eta}")
        right.plot(sizes, [eq2_budget(s, eta) for s in sizes], marker=".", label=f"eta = {eta}")
    left.set(xlabel="sampling budget N", ylabel="collaborators s", title="Eq. 1")
    right.set(xlabel="collaborators s", ylabel="sampling budget N", title="Eq. 2", yscale="log")
    left.legend(fontsize="small")
    save_figure(figure, context.out / "numerical.png", dpi=100)
    rows = [
        ("Eq. 1: s at N = 5, eta = 0.1", 4, eq1_collaborators(5, 0.1)),
        ("Eq. 2: N at s = 5, eta = 0.2", 12, eq2_budget(5, 0.2)),
    ]
    return Section(
        "Numerical figures",
        "Collaborators guaranteed by a budget, and the budget for a number of collaborators, at p = 0.99.",
        [Table("numerical", "The paper's examples", ("example", "paper", "ours"), rows)],
        ["numerical.png"],
    )


def ratio_estimation(context: Context) -> Section:
    """A2CP: total steps and estimate for each true ratio."""
    rows = []
    for attackers, (paper_steps, paper_estimate) in enumerate(paper.RATIO_ESTIMATION):
        oracle = [
            _estimate_by_oracle(attackers, context.rng(5, attackers, run))
            for run in range(context.scale.oracle_runs // 4)
        ]
        detector = [
            _estimate_by_detector(context.sequence(number, attackers), context.rng(6, attackers, number))
            for number in range(context.scale.sequences)
        ]
        steps = (round(float(np.mean([run[0] for run in runs])), 1) for runs in (oracle, detector))
        estimates = (round(float(np.mean([run[1] for run in runs])), 2) for runs in (oracle, detector))
        rows.append((attackers / TEAM_SIZE, paper_steps, *steps, paper_estimate, *estimates))
    columns = ("true ratio", "steps, paper", "oracle", "detector", "estimate, paper", "oracle", "detector")
    return Section(
        "Attacker ratio estimation",
        "A2CP with retrospect, N = 5: total sampling steps until all ratios are settled, and the estimate then. The "
        f"detector's column averages {context.scale.sequences} sequences under PGD; a sequence that ends before all is "
        f"settled is gone through again (up to {MOST_FRAMES} frames).",
        [Table("ratio_estimation", "Total steps and estimate", columns, rows)],
    )


def _settled(state: State) -> bool:
    return all(t >= u for t, u in zip(state["attempts"], state["bounds"], strict=True))


def _estimate_by_oracle(attackers: int, rng: np.random.Generator) -> tuple[int, float]:
    team = [f"v{i}" for i in range(TEAM_SIZE)]
    defense = A2CP()
    state, steps = defense.initial_state(team), 0
    while not _settled(state):
        decision, outcomes = converse_with_oracle(defense, team, team[:attackers], state, rng)
        state, steps = decision.state, steps + len(outcomes)
    return steps, state["estimate"]


def _estimate_by_detector(sequence: list[DecodedOnce], rng: np.random.Generator) -> tuple[int, float]:
    session = Session(sequence[0], sequence[0].team, A2CP(), rng=rng)
    steps = index = 0
    while not _settled(session.state) and index < MOST_FRAMES:
        recorded = sequence[index % len(sequence)]
        result = session.answer(index, recorded.ego, recorded.teammates, detector=recorded)
        steps, index = steps + result.sampling_steps, index + 1
    return steps, session.state["estimate"]
