"""Help texts fit a terminal of 80 columns, say what an option takes, and never cut its name."""

import re
import subprocess
import sys
from typing import Annotated

import pytest
import typer
import typer.main
from typer.testing import CliRunner

from bricktrack_host.cli._errors import BricktrackGroup
from bricktrack_host.cli._help import flowing
from bricktrack_host.cli.main import app as bricktrack


def _paths(command, path=()):
    yield path
    for name, child in getattr(command, "commands", {}).items():
        yield from _paths(child, (*path, name))


def _help(app, *path):
    done = CliRunner().invoke(app, [*path, "--help"], env={"COLUMNS": "80"}, prog_name="bricktrack")
    assert done.exit_code == 0, done.output
    return done.output


def _command(path):
    command = typer.main.get_command(bricktrack)
    for name in path:
        command = command.commands[name]
    return command


@pytest.mark.parametrize("path", list(_paths(typer.main.get_command(bricktrack))), ids=" ".join)
def test_no_line_is_cut_and_every_option_is_named_whole(path):
    shown = _help(bricktrack, *path)
    assert max(len(line) for line in shown.splitlines()) <= 80
    assert "…" not in shown
    for parameter in _command(path).params:
        assert not re.search(r"(?<!\\)\[", parameter.help or ""), f"{parameter.help} (taken for markup)"
        for name in (*parameter.opts, *parameter.secondary_opts):
            if name.startswith("--") and not name.startswith("--no-"):
                assert re.search(rf"{re.escape(name)}(?![\w-])", shown), name


def _small_app():
    app = typer.Typer(cls=BricktrackGroup)

    @app.callback()
    def group() -> None:
        """Have commands."""

    @app.command()
    def turn(
        sensors: Annotated[list[str] | None, typer.Option(help="Which.")] = None,
        rate: Annotated[float, typer.Option(min=0.5, max=60, help="How fast, Hz.")] = 2.0,
        wait: Annotated[bool, typer.Option(help="Stay.")] = True,
        simulated: Annotated[bool | None, typer.Option("--simulated/--real", help="Which kind.")] = None,
        quiet: Annotated[bool, typer.Option(help="Say less.")] = False,
    ) -> None:
        """Turn it.

        This paragraph stands on lines that are
        shorter than those of the terminal.

        For example:

            bricktrack turn --rate 2 --sensors first-one-of-them --sensors second-one-of-them --no-wait --real
        """

    return app


def test_a_type_is_said_once_and_limits_and_opposites_in_words():
    shown = " ".join(re.sub("[│╭╮╰╯─]", " ", _help(_small_app(), "turn")).split())
    assert "--sensors <text> Which." in shown
    assert "--rate <float> How fast, Hz. [0.5 to 60] [default: 2.0]" in shown
    assert "--wait Stay. [default: on; off: --no-wait]" in shown
    assert "--simulated Which kind. [the opposite: --real]" in shown
    assert "--quiet Say less. --help" in shown  # nobody needs --no-quiet
    assert "lines that are shorter than those" in _help(_small_app(), "turn").replace("\n", " ")


def test_what_is_shown_otherwise_is_taken_as_before():
    for option in ("--no-wait", "--real", "--no-quiet", "--simulated"):
        assert CliRunner().invoke(_small_app(), ["turn", option]).exit_code == 0
    assert CliRunner().invoke(_small_app(), ["turn", "--rate", "61"]).exit_code == 2


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
@pytest.mark.parametrize(
    "before",
    [
        ["calibrate", "fit", "-o", "c.json", "--a-mm"],
        ["target", "-o", "t.pdf", "--planes-mm", "100"],
        ["arm", "--duration"],
    ],
)
def test_what_is_no_number_is_refused_before_anything_is_done(before, number):
    done = CliRunner().invoke(bricktrack, [*before, number])
    assert done.exit_code == 2
    assert before[-1 if before[-1].startswith("-") else -2] in done.output


@pytest.mark.parametrize("before", [["report"], ["status", "--fleet"], ["dataset", "add", "campaign"]])
def test_a_name_that_no_file_can_have_is_refused_before_anything_is_done(before):
    done = CliRunner().invoke(bricktrack, [*before, "x" * 300])
    assert done.exit_code == 2
    assert "longer than a name can be" in " ".join(done.output.split())


def test_a_shell_takes_an_example_as_it_is_shown():
    words = ["--picture", "101.117=near.png", "--picture", "161.111=far.png", "--origin-near", "960", "540"]
    example = flowing(" ".join(["bricktrack", "calibrate", "fit", *words]))
    assert "\\\n" in example
    code = "import sys; print(sys.argv[1:])"
    script = example.replace("bricktrack calibrate fit", f"{sys.executable} -c '{code}'")
    done = subprocess.run(["sh", "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == str(words)
