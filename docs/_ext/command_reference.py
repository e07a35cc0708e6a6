"""The reference of both programs' commands, written from the programs themselves while the pages are built.

A page holds the line ``<!-- commands of NAME -->``; it becomes one section for each command of that program.
"""

import inspect
import re
from typing import Any

import typer.main
from sphinx.application import Sphinx

from bricktrack_device.cli import app as device_app
from bricktrack_host.cli.main import app as host_app

PROGRAMS = {"bricktrack": host_app, "bricktrackd": device_app}
_PLACE = re.compile(r"^<!-- commands of (\w+) -->$", flags=re.M)
_EXAMPLE = re.compile(r"(sudo )?bricktrackd? \S")


def setup(app: Sphinx) -> dict[str, object]:
    """Fill the page in as it is read."""
    app.connect("source-read", _fill_in)
    # The text depends on the code, which Sphinx does not watch.
    app.connect("env-get-outdated", lambda *_: {"reference/commands"})
    return {"parallel_read_safe": True, "version": "1"}


def _fill_in(_app: Sphinx, _page: str, source: list[str]) -> None:
    source[0] = _PLACE.sub(lambda found: commands_page(found[1]), source[0])


def commands_page(program: str) -> str:
    """Return the sections of all commands of a program, as Markdown."""
    command = typer.main.get_command(PROGRAMS[program])
    context = command.context_class(command, info_name=program, **command.context_settings)
    return "\n\n".join(_sections(command, context))


def _sections(command: Any, context: Any) -> list[str]:
    path = context.command_path
    children = getattr(command, "commands", None)
    if isinstance(children, dict):
        sections = [] if context.parent is None else [f"### {path}\n\n{_prose(command)}"]
        for name, child in children.items():
            inner = child.context_class(child, info_name=name, parent=context, **child.context_settings)
            sections += _sections(child, inner)
        return sections
    usage = re.sub(
        r"\{(\w+)\}", lambda m: m[1].upper(), " ".join([path, *command.collect_usage_pieces(context)])
    )
    parts = [f"### {path}", f"```text\n{usage}\n```", _prose(command), _parameters(command, context)]
    return ["\n\n".join(part for part in parts if part)]


def _prose(command: Any) -> str:
    """Return help and examples: paragraphs as they are, commands in blocks."""
    parts: list[str] = []
    for text in (command.help, command.epilog):
        for paragraph in re.split(r"\n\s*\n", inspect.cleandoc(text or "")):
            words = " ".join(paragraph.replace("\\\n", " ").split())
            if not _EXAMPLE.match(words):
                parts.append(_escaped(words))
            elif parts and parts[-1].startswith("```"):
                parts[-1] = parts[-1].removesuffix("```") + f"$ {words}\n```"
            else:
                parts.append(f"```console\n$ {words}\n```")
    return "\n\n".join(part for part in parts if part)


def _parameters(command: Any, context: Any) -> str:
    items = []
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record and "--help" not in parameter.opts:
            names, text = record
            items.append(f"`{_plain(names)}`\n: {_escaped(_plain(text)) or 'See above.'}")
    return "\n\n".join(items)


def _plain(text: str) -> str:
    """Return types and limits in the words that ``--help`` has for them."""
    text = re.sub(r"<list\[(\w+)\]>", r"<\1>", " ".join(text.split())).replace(" range>", ">")
    text = text.replace("<str>", "<text>").replace("<Path>", "<path>").replace(" <bool>", "")
    text = re.sub(r"([-\d.]+)<=x<=([-\d.]+)", r"\1 to \2", text)
    return re.sub(r"x>=([-\d.]+)", r"at least \1", re.sub(r"x<=([-\d.]+)", r"at most \1", text))


def _escaped(text: str) -> str:
    """Return text without the console's own markup, so that Markdown shows it as it is."""
    return re.sub(r"([<>*_|$])", r"\\\1", text.replace("\\[", "[").replace("[", "\\["))
