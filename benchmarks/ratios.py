"""All ratios of speed on one page: ``python benchmarks/ratios.py --out docs/speed.md``.

Everything is compared with something else that was measured turn by turn with it, by medians of processor time. One
torch thread. Takes about ten minutes; nothing else should work on the machine.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import torch
import typer
from rich.console import Console
from speed import ahead, defended, floors, once, served, v2xsim
from speed.turns import Part

from clients.machine import machine
from robosac.cli import outputs
from robosac.detectors import load
from robosac.files import write_text
from service.runtime import keep_what_is_loaded, tune_process

PARTS: dict[str, Callable[[int], list[Part]]] = {
    "once": lambda turns: [once.part(turns)],
    "v2xsim": lambda turns: [v2xsim.part(turns)],
    "ahead": lambda turns: [ahead.part(turns)],
    "defended": defended.parts,
    "floors": lambda turns: [floors.part(turns)],
    "served": served.parts,
}
HEAD = """# Speed

Written by `{command}` on {date}: {processor}, {cores} cores, Python {python}, torch {torch}.

Each figure is the median of processor time in units of something else that was measured turn by turn with it in the
same run, with the quartiles beside it. Ratios carry over between machines far better than seconds do. One torch
thread; nothing else worked on the machine.
"""
"""Of the page."""


def main(
    out: Annotated[Path | None, typer.Option(help="Markdown file to write; by default the page is printed.")] = None,
    only: Annotated[list[str] | None, typer.Option(help=f"Of {', '.join(PARTS)}; give it several times.")] = None,
    turns: Annotated[int, typer.Option(min=3)] = 15,
    force: outputs.Force = False,
) -> None:
    """Measure what each part compares, and write the page."""
    unknown = sorted(set(only or ()) - set(PARTS))
    if unknown:
        raise typer.BadParameter(f"{', '.join(unknown)}: not one of {', '.join(PARTS)}", param_hint="--only")
    if out is not None:
        outputs.check_file(out, "--out", force)
    tune_process()  # as a gateway does: else each frame's maps are faulted in anew
    torch.set_num_threads(1)
    load()
    keep_what_is_loaded()
    console = Console(stderr=True)
    sections = []
    for name in only or PARTS:
        console.print(f"measuring: {name}")
        sections += [part.markdown() for part in PARTS[name](turns)]
    about = machine()
    command = "python benchmarks/ratios.py" + "".join(f" --only {name}" for name in only or ())
    head = HEAD.format(
        command=command,
        date=datetime.now(UTC).date(),
        processor=about["processor"],
        cores=about["cores"],
        python=about["python"],
        torch=torch.__version__.partition("+")[0],
    )
    page = "\n".join([head, *sections]).rstrip() + "\n"
    if out is None:
        print(page)
    else:
        write_text(out, page)


if __name__ == "__main__":
    typer.run(main)
