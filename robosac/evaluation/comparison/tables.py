"""The tables of a comparison's report; another one is a function here and its place in `sections`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from robosac.evaluation.comparison.playing import EGO_ONLY, ORACLE
from robosac.evaluation.comparison.rows import EARLY, WINDOWS, Estimate, NamingFigures, Row
from robosac.evaluation.comparison.settings import NOBODY
from robosac.evaluation.report import Section, Table

_, SETTLED, LATE = WINDOWS


def sections(rows: Sequence[Row], precision_picture: str, passes_picture: str) -> list[Section]:
    """All tables that there is something for."""
    naming = [row for row in rows if row.naming is not None]
    found = [
        _pivot(
            "AP at IoU 0.5 / 0.7",
            rows,
            lambda row: f"{row.whole.ap50.value:.3f} / {row.whole.ap70.value:.3f}",
            precision_picture,
        ),
        _pivot(
            f"Fused passes a frame: first / 2 to {EARLY} / later",
            rows,
            lambda row: f"{row.passes_first:.1f} / {row.passes_early:.1f} / {row.passes_steady:.1f}",
            passes_picture,
        ),
        _pivot(
            "Share of frames with an attacking message in the answer", rows, lambda row: f"{row.whole.infiltrated:.2f}"
        ),
        _pivot("Share of honest messages left out", rows, lambda row: _number(row.honest_refused)),
        _pivot(
            "Time of a frame, median, ms",
            [row for row in rows if row.milliseconds is not None],
            lambda row: _number(row.milliseconds),
        ),
        _quiet([row for row in rows if row.setting == NOBODY]),
        _pivot(
            "Naming: sequences with all attackers named / frames it took / honest teammates named",
            naming,
            lambda row: _named(row.naming),
        ),
        *(_naming(name, rows) for name in dict.fromkeys(row.defense for row in naming)),
    ]
    return [section for section in found if section.tables[0].rows]


def _pivot(title: str, rows: Sequence[Row], cell: Callable[[Row], str], *pictures: str) -> Section:
    """A table with a line for each setting and a column for each defence."""
    names = list(dict.fromkeys(row.defense for row in rows))
    settings = list(dict.fromkeys(row.setting for row in rows))
    cells = {(row.setting, row.defense): cell(row) for row in rows}
    lines = [[setting.label, *(cells.get((setting, name), "") for name in names)] for setting in settings]
    return Section(title, "", [Table("", "", ["attack", *names], lines)], pictures)


def _quiet(rows: Sequence[Row]) -> Section:
    headings = ["defence", "AP50 lost", "AP70 lost", "passes, later frames", "honest messages left out"]
    lines = []
    for row in rows:
        lost = (f"{-d.value + 0.0:.3f}" for d in (row.whole.ap50_difference, row.whole.ap70_difference))
        lines.append([row.defense, *lost, f"{row.passes_steady:.2f}", _number(row.honest_refused)])
    return Section("What it costs when nobody attacks", "", [Table("", "", headings, lines)])


def _naming(defense: str, rows: Sequence[Row]) -> Section:
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
    text = f"Frames are counted from 0. Honest teammates named, over all attacks: {named} of {honest}."
    return Section(f"{defense} in detail", text, [Table("", "", headings, lines)])


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


def _named(naming: NamingFigures | None) -> str:
    if naming is None:
        return ""
    return f"{_number(naming.named_all)} / {_number(naming.frames_to_name)} / {naming.honest_named} of {naming.honest}"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _estimate(estimate: Estimate | None, sign: str = "") -> str:
    if estimate is None:
        return "-"
    error = "" if estimate.error is None else f" +- {estimate.error:.3f}"
    return f"{estimate.value:{sign}.3f}{error}"
