"""The tables of a comparison's report; another one is a function here and its place in `sections`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from robosac.evaluation.comparison.playing import EGO_ONLY, ORACLE
from robosac.evaluation.comparison.rows import (
    EARLY,
    WINDOWS,
    Estimate,
    Figures,
    NamingFigures,
    ObjectFigures,
    Row,
    StandingFigures,
)
from robosac.evaluation.comparison.settings import NOBODY
from robosac.evaluation.report import Section, Table

_, SETTLED, LATE = WINDOWS


def sections(rows: Sequence[Row], precision_picture: str, passes_picture: str) -> list[Section]:
    """All tables that there is something for."""
    naming = [row for row in rows if row.naming is not None]
    timed = [row for row in rows if row.milliseconds is not None]
    found = [
        _pivot("AP at IoU 0.5 / 0.7", rows, lambda row: _precision(row.whole), precision_picture),
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
        _pivot("Time of a frame, median, ms", timed, lambda row: _number(row.milliseconds)),
        _quiet([row for row in rows if row.setting == NOBODY]),
        _objects([row for row in rows if row.objects is not None]),
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
    lines = [
        {
            "defence": row.defense,
            "AP50 lost": f"{-row.whole.ap50_difference.value + 0.0:.3f}",
            "AP70 lost": f"{-row.whole.ap70_difference.value + 0.0:.3f}",
            "passes, later frames": f"{row.passes_steady:.2f}",
            "honest messages left out": _number(row.honest_refused),
            "honest named": f"{row.naming.honest_named} of {row.naming.honest}" if row.naming else "-",
            "in sequences": f"{row.naming.sequences_honest_named} of {row.naming.sequences}" if row.naming else "-",
        }
        for row in rows
    ]
    return Section("What it costs when nobody attacks", "", [Table.of(lines)])


def _objects(rows: Sequence[Row]) -> Section:
    text = (
        "An object frame is one lie about a single object in one frame. The answer *tells* it if it has the ghost, "
        "misses the erased vehicle where the oracle finds it, or shows the moved one nearer to the lie than to the "
        "truth. "
        "*Flagged* are lies that the answer contradicts or repairs. *Shows*: sequences in which the undefended fusion "
        "tells a lie at all; from its first frame there on frames to name are counted."
    )
    return Section("Objects", text, [Table.of([_told(row, row.objects) for row in rows if row.objects])])


def _told(row: Row, objects: ObjectFigures) -> dict[str, str]:
    named = row.naming is not None
    return {
        "attack": row.setting.label,
        "defence": row.defense,
        "tells the lie": _estimate(objects.held),
        "longest, frames": str(objects.longest),
        "flagged": _estimate(objects.flagged),
        "told as confirmed": _estimate(objects.confirmed),
        "by a single witness": _estimate(objects.single_witness),
        "as disputed": _estimate(objects.disputed),
        "frames to flag": _number(objects.frames_to_flag),
        "shows, sequences": str(objects.sequences_shown),
        "all attackers named in": f"{objects.shown_named} of {objects.sequences_shown}" if named else "-",
        "frames to name": _number(objects.frames_to_name_shown),
        "AP50/AP70": _precision(row.whole),
    }


def _naming(defense: str, rows: Sequence[Row]) -> Section:
    """All about one defence that names attackers, and a line on whom it named wrongly."""
    at = {(row.setting, row.defense): row for row in rows}
    own = [row for row in rows if row.defense == defense]
    lines = [_line(row, at[row.setting, ORACLE], at[row.setting, EGO_ONLY]) for row in own]
    named, honest, spoilt, played = (
        sum(getattr(row.naming, of, 0) for row in own)
        for of in ("honest_named", "honest", "sequences_honest_named", "sequences")
    )
    text = (
        f"Frames are counted from 0. Honest teammates named, over all attacks: {named} of {honest}. "
        f"Sequences with any of them named: {spoilt} of {played}. True boxes are those that match a true vehicle; "
        "contradicted ones are left out of the answer."
    )
    return Section(f"{defense} in detail", text, [Table.of(lines)])


def _line(row: Row, oracle: Row, alone: Row) -> dict[str, str]:
    settled, late, naming = row.windows[SETTLED], row.windows.get(LATE), row.naming
    struck = naming.attackers_struck if naming else 0
    return {
        "attack": row.setting.label,
        f"oracle AP50/AP70 from frame {SETTLED}": _precision(oracle.windows[SETTLED]),
        f"its AP50/AP70 from frame {SETTLED}": _precision(settled),
        "difference": f"{_estimate(settled.ap50_difference, '+')} / {_estimate(settled.ap70_difference, '+')}",
        f"AP70 ratio from frame {LATE}": _estimate(late.ap70_ratio) if late else "-",
        f"infiltrated from frame {LATE}": f"{late.infiltrated:.3f}" if late else "-",
        "AP70 ratio, all frames": _estimate(row.whole.ap70_ratio),
        "ego only AP70, all frames": f"{alone.whole.ap70.value:.3f}",
        "passes: first / 2 to 5 / later": f"{row.passes_first:.1f} / {row.passes_early:.1f} / {row.passes_steady:.2f}",
        "attackers named": f"{naming.attackers_named} of {struck}" if naming and struck else "-",
        "frames to name: mean, most": f"{naming.frames_to_name_each:.1f}, {naming.frames_to_name_most}"
        if naming and naming.frames_to_name_each
        else "-",
        "honest named": f"{naming.honest_named} of {naming.honest}" if naming else "-",
        "in sequences": f"{naming.sequences_honest_named} of {naming.sequences}" if naming else "-",
        **true_boxes(row.standing),
    }


def true_boxes(standing: StandingFigures | None) -> dict[str, str]:
    """Cells that tell how true boxes stand."""
    return {
        "true boxes contradicted, of 1000": _estimate(standing.true_contradicted.times(1000)) if standing else "-",
        "true boxes confirmed": _estimate(standing.true_confirmed) if standing else "-",
    }


def _precision(figures: Figures) -> str:
    return f"{figures.ap50.value:.3f} / {figures.ap70.value:.3f}"


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
