"""What the documentation tells to type is what the programs take: commands, options, values, and Python names."""

import ast
import doctest
import importlib
import re
from typing import Any

import pytest
import typer.main
from page_commands import FENCE, PREFIX, ROOT, commands_on, words_of

from bricktrack_device.cli import app as device_app
from bricktrack_host.cli.main import app as host_app

PAGES = [
    ROOT / "README.md",
    *sorted(p for p in (ROOT / "docs").rglob("*.md") if "_build" not in p.parts),
]
PROGRAMS = {
    "bricktrack": typer.main.get_command(host_app),
    "bricktrackd": typer.main.get_command(device_app),
}

# What stands for something else, in commands that show a form and not a case.
_PLACEHOLDER = re.compile(r"^(\.\.\.|…|[A-Z_]{2,}|<.*>|\[.*\])$")


def why_refused(words: list[str], *, whole: bool) -> str | None:
    """Return what the program would say against this command line, or None; files need not exist.

    Parameters
    ----------
    words : list of str
        The program's name, and what follows it.
    whole : bool
        Whether required arguments must be there, and values be in range.
    """
    command = PROGRAMS[words[0]]
    context = command.context_class(command, info_name=words[0], **command.context_settings)
    rest = words[1:]
    while isinstance(getattr(command, "commands", None), dict):
        values, rest, _ = command.make_parser(context).parse_args(list(rest))
        if values.get("help") or values.get("version") or (not rest and not whole):
            return None
        if not rest or rest[0] not in command.commands:
            return f"'{context.command_path}' has no command '{rest[0] if rest else ''}'"
        child = command.commands[rest[0]]
        context = child.context_class(child, info_name=rest[0], parent=context, **child.context_settings)
        command, rest = child, rest[1:]
    if not whole:
        # A sentence may name an option without its value.
        known = {name for p in command.params for name in (*p.opts, *p.secondary_opts)}
        known.update(command.get_help_option_names(context))
        used = [word.split("=")[0].rstrip(",.") for word in rest if word.startswith("-")]
        unknown = [word for word in used if word not in known]
        return f"'{context.command_path}' has no option {', '.join(unknown)}" if unknown else None
    try:
        values, rest, _ = command.make_parser(context).parse_args(list(rest))
        if rest:
            return f"'{context.command_path}' takes no '{rest[0]}'"
        if values.get("help"):
            return None
        for parameter in command.params:
            _check_value(parameter, values.get(parameter.name), context)
    except Exception as error:
        if hasattr(error, "format_message"):  # typer may bring click's classes under a name of its own
            return f"'{context.command_path}': {error.format_message()}"
        raise
    return None


def _check_value(parameter: Any, value: object, context: Any) -> None:
    given = value if isinstance(value, (list, tuple)) else [value]
    if any(isinstance(v, str) and _PLACEHOLDER.match(v) for v in given):
        return
    try:
        parameter.process_value(context, parameter.get_default(context) if value is None else value)
    except Exception as error:
        if "does not exist" not in getattr(error, "message", ""):
            raise


COMMANDS = [c for page in PAGES for c in commands_on(str(page.relative_to(ROOT)), page.read_text())]


def test_the_pages_hold_commands_to_look_at():
    assert sum(c.whole for c in COMMANDS) > 50
    assert {c.page for c in COMMANDS} >= {
        "README.md",
        "docs/how-to/fleet.md",
        "docs/tutorials/first-recording.md",
    }


@pytest.mark.parametrize("page", sorted({c.page for c in COMMANDS}))
def test_every_command_of_a_page_is_one_the_program_takes(page):
    refused = []
    for command in COMMANDS:
        if command.page == page and (why := why_refused(words_of(command.text), whole=command.whole)):
            refused.append(f"{command.text}\n    {why}")
    assert not refused, "\n".join(refused)


def _leaves(command: Any, path: str) -> list[tuple[str, Any]]:
    children = getattr(command, "commands", None)
    if not isinstance(children, dict):
        return [(path, command)]
    return [leaf for name, child in children.items() for leaf in _leaves(child, f"{path} {name}")]


LEAVES = dict(leaf for name, program in PROGRAMS.items() for leaf in _leaves(program, name))


@pytest.mark.parametrize("path", sorted(LEAVES))
def test_the_examples_in_a_help_text_are_commands_the_program_takes(path):
    command = LEAVES[path]
    text = "\n\n".join(filter(None, (command.help, command.epilog)))
    paragraphs = [
        PREFIX.sub("", " ".join(part.replace("\\\n", " ").split())) for part in re.split(r"\n\s*\n", text)
    ]
    examples = [part for part in paragraphs if re.match(r"bricktrackd? [^ ]", part)]
    assert examples, f"'{path} --help' shows no example"
    refused = [f"{line}: {why}" for line in examples if (why := why_refused(words_of(line), whole=True))]
    assert not refused, "\n".join(refused)


@pytest.mark.parametrize("program", sorted(PROGRAMS))
def test_the_reference_describes_every_command_and_option(program, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs" / "_ext")
    sections = re.split(
        r"^### ", importlib.import_module("command_reference").commands_page(program), flags=re.M
    )
    described = {section.partition("\n")[0]: section for section in sections}
    for path, command in LEAVES.items():
        if path.split()[0] == program:
            options = {name for p in command.params for name in p.opts if name.startswith("--")}
            unsaid = [name for name in options - {"--help"} if name not in described[path]]
            assert not unsaid, f"{path}: {unsaid}"


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ("bricktrack proces runs/x", "has no command 'proces'"),
        ("bricktrack process runs/x --jobz 3", "No such option: --jobz"),
        ("bricktrack process runs/x --jobs many", "valid integer"),
        ("bricktrack calibrate leds runs/x", "Missing option '--calibration'"),
        ("bricktrackd sim-kit kit again", "takes no 'again'"),
        ("bricktrackd check --slots 5", "No such option: --slots"),
    ],
)
def test_a_command_that_is_wrong_is_refused(line, why):
    assert why.lower() in (why_refused(words_of(line), whole=True) or "").lower()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "```console\n$ bricktrack pull \\\n    --watch\nwhat it prints\n```\n",
            ["bricktrack pull      --watch"],
        ),
        (
            "```shell\n$ sudo -u bricktrack /opt/bricktrack/bin/bricktrackd check | tee log\n```\n",
            ["bricktrackd check | tee log"],
        ),
        ("run it:\n\n    bricktrack evaluate\n", ["bricktrack evaluate"]),
        ("say `bricktrack find`, then\n```text\nbricktrack is a program\n```\n", ["bricktrack find"]),
    ],
)
def test_commands_are_found_in_a_page(text, expected):
    assert [c.text for c in commands_on("page", text)] == expected


def _python_blocks() -> list[tuple[str, str]]:
    blocks = []
    for page in PAGES:
        for fence in FENCE.finditer(page.read_text()):
            if fence[3].strip() in {"python", "py"}:
                blocks.append((str(page.relative_to(ROOT)), fence[4]))
    return blocks


@pytest.mark.parametrize(("page", "code"), _python_blocks())
def test_python_on_a_page_is_python_and_names_what_exists(page, code):
    for node in ast.walk(ast.parse(code, filename=page)):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("bricktrack"):
            module = importlib.import_module(node.module)
            for alias in node.names:
                if not hasattr(module, alias.name):
                    importlib.import_module(f"{node.module}.{alias.name}")
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.startswith("bricktrack"):
                    importlib.import_module(alias.name)


def _source_text() -> str:
    """Return the programs' source with strings that stand one below the other joined, as they are printed."""
    files = [
        p
        for side in ("common/bricktrack_common", "device/bricktrack_device", "host/bricktrack_host")
        for p in sorted((ROOT / side).rglob("*.py"))
    ]
    return re.sub(r"\"\s*\n\s*f?\"", "", "\n".join(p.read_text() for p in files))


def test_messages_in_troubleshooting_are_ones_the_programs_print():
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    source = _source_text()
    said = re.findall(r"^\| `([^`]+)`", page, flags=re.M)
    assert len(said) > 20
    pieces = [piece.strip() for words in said for piece in words.split("...") if piece.strip()]
    never = [piece for piece in pieces if piece not in source]
    assert not never, "\n".join(never)


def test_what_a_session_on_a_page_prints_is_what_the_code_prints():
    n_tried = 0
    for page in PAGES:
        for fence in FENCE.finditer(page.read_text()):
            if fence[3].strip() == "pycon":
                name = str(page.relative_to(ROOT))
                session = doctest.DocTestParser().get_doctest(fence[4], {}, name, name, 0)
                failed, tried = doctest.DocTestRunner(verbose=False).run(session)
                assert not failed, name
                n_tried += tried
    assert n_tried
