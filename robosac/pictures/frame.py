"""One frame: what was answered, and every hypothesis as it was tested, with the evidence on its boxes."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from robosac.answers import Distrust, Verdict
from robosac.consensus import at_least, match
from robosac.defenses import Difference, Outcome
from robosac.figures import new_figure, save_figure
from robosac.pictures import above
from robosac.pictures.moments import Moment

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

MOST_TESTS = 15
"""Of a frame are drawn, the first ones."""
VERDICTS = {
    Verdict.CONSENSUS: ("consensus", above.BLUE, "-"),
    Verdict.DISSENSUS: ("dissensus", above.VERMILLION, "--"),
    Verdict.NO_EVIDENCE: ("no evidence", "#777777", ":"),
}
WIDTH = 17.0
DPI = 100


def draw_frame(moment: Moment, path: Path, title: str) -> None:
    """Write the picture of a frame; the suffix chooses the format."""
    save_figure(frame_figure(moment, title), path, dpi=DPI)


def frame_figure(moment: Moment, title: str) -> Figure:
    """Draw a frame.

    On the left are the answer with its boxes as they stand, the teammates, and why each is in it or not; on the right
    are the ego alone and the hypotheses in the order tested, each with its verdict and the evidence on its boxes.

    Parameters
    ----------
    moment : Moment
    title : str
        What stands above it.
    """
    tests = moment.result.hypotheses[:MOST_TESTS]
    columns = next(n for n in (1, 2, 3, 4) if n * n >= len(tests) + 1 or n == 4)
    figure = new_figure(WIDTH, 10.5)
    figure.suptitle(title, fontsize=13)
    parts: Any = figure.subfigures(1, 2, width_ratios=(1, 1.15))
    left, right = parts
    keys = _answer(left, moment)
    panels = right.subplots(-(-(len(tests) + 1) // columns), columns, squeeze=False).ravel()
    _own(panels[0], moment)
    found = [
        _test(axes, moment, number, test) for number, (axes, test) in enumerate(zip(panels[1:], tests, strict=False))
    ]
    for axes in panels:
        axes.set_anchor("N")
    for axes in panels[len(tests) + 1 :]:
        axes.set_axis_off()
    more = len(moment.result.hypotheses) - len(tests)
    attacked = "; * holds an attacker" if moment.met.attackers else ""
    cut = f"; {more} more are not shown" if more else ""
    right.suptitle(f"The ego alone, and what was tested{attacked}{cut}", fontsize=11)
    seen = set().union(*found)
    keys_right = [above.key_of_truth(), above.key_of_line(above.OWN), above.key_of_line(above.FUSED)]
    keys_right += [above.key_of_mark(kind) for kind in above.MARKS if kind in seen]
    for part, handles in ((left, keys), (right, keys_right)):
        part.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    return figure


def _answer(figure: SubFigure, moment: Moment) -> list[Artist]:
    """The answer, and below it the team."""
    view, table = figure.subplots(2, 1, height_ratios=(4.2, 1))
    above.prepare(view, moment)
    above.answered(view, moment)
    for lie in moment.met.lies:
        above.boxes(view, lie.box[None], above.LIE, zorder=4)
    done = above.marks(view, moment.result.differences, above.BLAMED, 8)
    above.team(view, moment)
    fused = ", ".join(moment.result.accepted) or "nobody"
    source = moment.result.source.value.replace("_", " ")
    view.set_title(f"Answered: {source}, fused with {fused}", fontsize=11)
    _team(table, moment)
    lines = list(above.STANDINGS.values()) if moment.answer.support is not None else [above.ANSWERED]
    lines += [above.LIE] if moment.met.lies else []
    marks = [above.key_of_mark(kind) for kind in above.BLAMED if kind in done]
    return [above.key_of_truth(), *map(above.key_of_line, lines), *above.keys_of_vehicles(), *marks]


def _team(axes: Axes, moment: Moment) -> None:
    """Suspicion of each teammate as bars, where the defence knows it, and what became of it."""
    suspicion, names = moment.result.suspicion, list(moment.met.team)
    axes.set(xlim=(0, 1), ylim=(len(names) - 0.5, -0.5), yticks=range(len(names)))
    axes.set_yticklabels([f"{name}*" if name in moment.met.attackers else name for name in names], fontsize=9)
    for row, name in enumerate(names):
        p = None if suspicion is None else suspicion.get(name, 0.0)
        if p is not None:
            axes.barh(row, p, color=above.VERMILLION if name in moment.named else above.SKY, height=0.7)
        said = f"{'' if p is None else f'{p:.3f}, '}{_standing(moment, name)}"
        high = p is not None and p > 0.5
        axes.text(0.01 if high else (p or 0.0) + 0.01, row, said, va="center", fontsize=9, color="black")
    what = "Suspicion" if suspicion is not None else "The team (this defence knows no suspicion)"
    axes.set_title(f"{what}{'; * attacks in this frame' if moment.met.attackers else ''}", fontsize=10)
    axes.tick_params(length=0)
    if suspicion is None:
        axes.set_xticks([])
    for side in ("top", "right", "bottom"):
        axes.spines[side].set_visible(False)


def _standing(moment: Moment, name: str) -> str:
    if name in moment.result.accepted:
        return "fused"
    entry = moment.answer.rejected[name]
    if entry.distrust is Distrust.NAMED:
        return "left out: named as an attacker"
    return f"left out: {(entry.distrust or entry.reason).value.replace('_', ' ')}"


def _own(axes: Axes, moment: Moment) -> None:
    above.prepare(axes, moment)
    above.boxes(axes, moment.fused(), above.OWN)
    axes.set_title(f"the ego alone\n{len(moment.fused())} boxes", fontsize=9)


def _test(axes: Axes, moment: Moment, number: int, test: Outcome) -> set[str]:
    """A hypothesis; the kinds of evidence that there were on its boxes."""
    above.prepare(axes, moment)
    above.boxes(axes, moment.fused(), above.OWN, zorder=2)
    if test.boxes is not None:
        above.boxes(axes, at_least(test.boxes, moment.met.info.consensus_score), above.FUSED)
    about = [each for each in moment.result.differences if set(each.teammates) == set(test.teammates)]
    about = about if moment.result.differences else _unmatched(test, moment.met.info.consensus_score)
    seen = above.marks(axes, about, above.MARKS, 6)
    verdict, colour, style = VERDICTS[test.verdict]
    for spine in axes.spines.values():
        spine.set(color=colour, linestyle=style, linewidth=2.2)
    who = _who(test.teammates, moment.met.team)
    held = sum(name in moment.met.attackers for name in test.teammates)
    attacked = " *" if held else ""
    axes.set_title(
        f"{number + 1}: {who}{attacked}\n{verdict}, agreement {test.jaccard_index:.2f}", fontsize=9, color=colour
    )
    return seen


def _unmatched(test: Outcome, least_score: float) -> list[Difference]:
    """What the consensus test finds no partner for, which is the evidence where a defence compares nothing else."""
    reference, boxes = test.reference, test.boxes
    if reference is None or boxes is None:
        return []
    fused = at_least(boxes, least_score)
    lost, added = (
        np.setdiff1d(np.arange(len(of)), matched)
        for of, matched in zip((reference, fused), match(reference, fused), strict=True)
    )
    places = {"lost": reference[lost, :2], "added": fused[added, :2]}
    return [Difference("consensus", test.teammates, (), lambda: places)]


def _who(subset: Sequence[str], team: Collection[str]) -> str:
    """The members of a subset, or who is missing where that is shorter."""
    without = [name for name in team if name not in subset]
    if not without:
        return f"all {len(subset)}"
    shorter = len(without) < len(subset) / 2
    return f"all but {', '.join(without)}" if shorter else ", ".join(subset)
