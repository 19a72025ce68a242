"""The page, the table and the pictures of a comparison."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from robosac.evaluation.comparison.pictures import draw_passes, draw_precision
from robosac.evaluation.comparison.playing import Plan
from robosac.evaluation.comparison.rows import EARLY, WINDOWS, Estimate, Figures, NamingFigures, Row
from robosac.evaluation.comparison.settings import NOBODY
from robosac.evaluation.comparison.tables import naming_table, number, pivot, quiet_table

TEXT = """# Defences against attacks

`{command}`: {scenes} test sequences of {frames} frames at 5 Hz, car-1 the ego, attackers drawn among its five
teammates{poses}. In each setting all defences meet the same frames. *Oracle* fuses everybody who is honest in the
frame. Passes are fused ones; that of the ego alone comes on top. Standard errors (+-) are over sequences, by the
jackknife; those of differences and ratios to the oracle take both on the same sequences. All figures are in
`comparison.csv`.
"""


def write_comparison(rows: Sequence[Row], plan: Plan, out: Path, command: str) -> Path:
    """Write ``comparison.md``, ``comparison.csv``, ``precision.png`` and ``passes.png`` into a folder.

    Returns
    -------
    Path
        Of the Markdown page.
    """
    _write_csv(rows, out / "comparison.csv")
    draw_precision(rows, out / "precision.png")
    draw_passes(rows, out / "passes.png")
    poses = f", teammates wrong about their positions by {plan.pose_error_m:g} m" if plan.pose_error_m else ""
    text = TEXT.format(command=command, scenes=plan.extent.scenes, frames=plan.extent.frames, poses=poses)
    parts = [
        text,
        pivot("AP at IoU 0.5 / 0.7", rows, lambda row: f"{row.whole.ap50.value:.3f} / {row.whole.ap70.value:.3f}"),
        "![AP at IoU 0.7, and what is lost against the oracle](precision.png)\n",
        pivot(
            f"Fused passes a frame: first / 2 to {EARLY} / later",
            rows,
            lambda row: f"{row.passes_first:.1f} / {row.passes_early:.1f} / {row.passes_steady:.1f}",
        ),
        "![Precision against passes](passes.png)\n",
        pivot(
            "Share of frames with an attacking message in the answer", rows, lambda row: f"{row.whole.infiltrated:.2f}"
        ),
        pivot("Share of honest messages left out", rows, lambda row: number(row.honest_refused)),
    ]
    timed = [row for row in rows if row.milliseconds is not None]
    if timed:
        parts.append(pivot("Time of a frame, median, ms", timed, lambda row: number(row.milliseconds)))
    quiet = [row for row in rows if row.setting == NOBODY]
    if quiet:
        parts.append(quiet_table(quiet))
    naming = {row.defense: row for row in rows if row.naming is not None}
    if naming:
        parts.append(
            pivot(
                "Naming: sequences with all attackers named / frames it took / honest teammates named",
                [row for row in rows if row.naming is not None],
                lambda row: "" if row.naming is None else _named(row.naming),
            )
        )
    parts += [naming_table(name, rows) for name in naming]
    path = out / "comparison.md"
    path.write_text("\n".join(parts))
    return path


def _named(naming: NamingFigures) -> str:
    return f"{number(naming.named_all)} / {number(naming.frames_to_name)} / {naming.honest_named} of {naming.honest}"


ESTIMATES = ("ap50", "ap70", "ap50_difference", "ap70_difference", "ap70_ratio")
OVERALL = ("passes_first", "passes_early", "passes_steady", "honest_refused", "milliseconds")
NAMING = tuple(NamingFigures.__dataclass_fields__)


def _write_csv(rows: Sequence[Row], path: Path) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(_flat(rows[0])))
        writer.writeheader()
        for row in rows:
            writer.writerow(_flat(row))


def _flat(row: Row) -> dict[str, object]:
    """Figures from a frame on end in ``_from_5`` and the like, standard errors in ``_se``."""
    line: dict[str, object] = {
        "campaign": row.setting.campaign,
        "attackers": row.setting.attackers,
        "defense": row.defense,
    }
    for first in WINDOWS:
        suffix = f"_from_{first}" if first else ""
        line |= {f"{name}{suffix}": value for name, value in _figures(row.windows.get(first)).items()}
    line |= {name: _rounded(getattr(row, name)) for name in OVERALL}
    line |= {name: _rounded(getattr(row.naming, name, None)) for name in NAMING}
    return line


def _figures(figures: Figures | None) -> dict[str, object]:
    line: dict[str, object] = {}
    for name in ESTIMATES:
        estimate: Estimate | None = getattr(figures, name, None)
        line[name] = _rounded(estimate.value if estimate else None)
        line[f"{name}_se"] = _rounded(estimate.error if estimate else None)
    return line | {"infiltrated": _rounded(figures.infiltrated if figures else None)}


def _rounded(value: float | None) -> float | str:
    return "" if value is None else round(value, 5)
