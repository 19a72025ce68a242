"""``robosac scene``: a picture of one frame."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from robosac.cli.blame import blaming, check_known
from robosac.cli.outputs import Force, check_file
from robosac.scenes import IntersectionScene
from robosac.scenes.drawing import draw_view


def run(
    out: Annotated[Path, typer.Option(help="The picture; the suffix chooses the format (png, svg, pdf).")],
    seed: Annotated[int, typer.Option(min=0, help="The scene.")] = 8,
    frame: Annotated[int, typer.Option(min=0, help="The frame, at 5 Hz.")] = 0,
    agent: Annotated[str, typer.Option(help="Whose view to draw: car-1 to car-5, or rsu.")] = "car-1",
    force: Force = False,
) -> None:
    """Draw the bird's eye view of one agent: LiDAR returns, true boxes, and which of them are hidden from it."""
    scene = IntersectionScene(seed)
    check_known([agent], scene.agents, "--agent")
    check_file(out, "--out", force)
    with blaming("--out", OSError, ValueError):  # matplotlib names the formats it knows
        seen, hidden = draw_view(scene.frame(frame), agent, out, f"scene {seed}, ")
    typer.echo(f"{out}: {agent} sees {seen} vehicles; {hidden} more are hidden from it and seen by a teammate")
