"""What the site adds to the Markdown pages: the options of every command, read from the commands themselves."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from robosac.cli import commands


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Called by MkDocs for each page; only the page on commands is changed."""
    if page.file.src_uri != "commands.md":
        return markdown
    sections = [
        line for name, place in commands.places().items() for line in _section(name, commands.load(name, place))
    ]
    return "\n".join([markdown, *sections])


def _section(name: str, command: Any) -> Iterator[str]:
    """A command's help, usage and options; those of its own commands after it."""
    context = command.make_context(f"robosac {name}", [], resilient_parsing=True)
    usage = " ".join([context.command_path, *command.collect_usage_pieces(context)])
    yield f"\n## {name}\n\n{command.help}\n\n```\n{usage}\n```\n"
    records = [param.get_help_record(context) for param in command.params]
    if any(records):
        yield "| option | meaning |\n|---|---|"
        yield from (f"| `{_cell(record[0])}` | {_cell(record[1])} |" for record in records if record)
    for child, subcommand in getattr(command, "commands", {}).items():
        yield from _section(f"{name} {child}", subcommand)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
