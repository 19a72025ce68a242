"""Markdown tables of a comparison."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from robosac.evaluation.comparison.playing import EGO_ONLY, ORACLE
from robosac.evaluation.comparison.rows import WINDOWS, Estimate, Row

_, SETTLED, LATE = WINDOWS


def number(value: float | None) -> str:
    """Two decimals, or a dash."""
    return "-" if value is None else f"{value:.2f}"


def pivot(title: str, rows: Sequence[Row], cell: Callable[[Row], str]) -> str:
    """A table with a line for each setting and a column for each defence."""
    names = list(dict.fromkeys(row.defense for row in rows))
    settings = list(dict.fromkeys(row.setting for row in rows))
    cells = {(row.setting, row.defense): cell(row) for row in rows}
    lines = [[setting.label, *(cells.get((setting, name), "") for name in names)] for setting in settings]
    return _table(title, ["attack", *names], lines)


def quiet_table(rows: Sequence[Row]) -> str:
    """What each defence costs when nobody attacks."""
    headings = ["defence", "AP50 lost", "AP70 lost", "passes, later frames", "honest messages left out"]
    lines = []
    for row in rows:
        lost = (f"{-d.value + 0.0:.3f}" for d in (row.whole.ap50_difference, row.whole.ap70_difference))
        lines.append([row.defense, *lost, f"{row.passes_steady:.2f}", number(row.honest_refused)])
    return _table("What it costs when nobody attacks", headings, lines)


def naming_table(defense: str, rows: Sequence[Row]) -> str:
    """All about one defence that names attackers, and a line on whom it named wrongly."""
    at = {(row.setting, row.defense): row for row in rows}
    own = [row for row in rows if row.defense == defense]
    headings = [
        "attack",
        f"oracle AP50/AP70 from frame {SETTLED}",
        f"its AP50/AP70 from frame {SETTLED}",
        "difference",
        f"AP70 ratio from frame {LATE}",
        f"infiltrated from frame {LATE}",
        "AP70 ratio, all frames",
        "ego only AP70, all frames",
        "passes: first / 2 to 5 / later",
        "attackers named",
        "frames to name: mean, most",
        "honest named",
    ]
    lines = [_line(row, at[row.setting, ORACLE], at[row.setting, EGO_ONLY]) for row in own]
    named, honest = (sum(getattr(row.naming, of, 0) for row in own) for of in ("honest_named", "honest"))
    title = f"{defense} in detail (frames are counted from 0)"
    return f"{_table(title, headings, lines)}\nHonest teammates named, over all attacks: {named} of {honest}.\n"


def _line(row: Row, oracle: Row, alone: Row) -> list[str]:
    settled, ideal, late = row.windows.get(SETTLED), oracle.windows.get(SETTLED), row.windows.get(LATE)
    cells = [row.setting.label]
    if settled is None or ideal is None:
        cells += ["-"] * 3
    else:
        cells += [f"{figures.ap50.value:.3f} / {figures.ap70.value:.3f}" for figures in (ideal, settled)]
        cells += [f"{_estimate(settled.ap50_difference, '+')} / {_estimate(settled.ap70_difference, '+')}"]
    cells += ["-", "-"] if late is None else [_estimate(late.ap70_ratio), f"{late.infiltrated:.3f}"]
    cells += [_estimate(row.whole.ap70_ratio), f"{alone.whole.ap70.value:.3f}"]
    cells += [f"{row.passes_first:.1f} / {row.passes_early:.1f} / {row.passes_steady:.2f}"]
    naming = row.naming
    if naming is None:
        return [*cells, "-", "-", "-"]
    cells += [f"{naming.attackers_named} of {naming.attackers_struck}" if naming.attackers_struck else "-"]
    cells += [f"{naming.frames_to_name_each:.1f}, {naming.frames_to_name_most}" if naming.frames_to_name_each else "-"]
    return [*cells, f"{naming.honest_named} of {naming.honest}"]


def _estimate(estimate: Estimate | None, sign: str = "") -> str:
    if estimate is None:
        return "-"
    error = "" if estimate.error is None else f" +- {estimate.error:.3f}"
    return f"{estimate.value:{sign}.3f}{error}"


def _table(title: str, headings: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    rows = [f"## {title}", "", f"| {' | '.join(headings)} |", "|---" * len(headings) + "|"]
    return "\n".join([*rows, *(f"| {' | '.join(line)} |" for line in lines), ""])
