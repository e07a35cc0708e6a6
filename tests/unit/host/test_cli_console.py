"""Long lines: whole for programs, broken between words for people."""

import io

from bricktrack_host.cli._console import LineConsole

TEXT = (
    "  no layout for unit b7-1 in lab/fleet.toml. Name it with --layout, or write layout = ... for this unit"
)


def printed(text, **console):
    file = io.StringIO()
    LineConsole(file=file, highlight=False, **console).print(text, markup=False, soft_wrap=True)
    return file.getvalue()


def test_a_pipe_gets_a_line_whole():
    assert printed(TEXT, width=40, force_terminal=False) == TEXT + "\n"


def test_a_terminal_shows_whole_words_under_the_same_indent():
    lines = printed(TEXT, width=40, force_terminal=True, color_system=None).splitlines()
    assert len(lines) == 3
    assert all(len(line) <= 40 and line.startswith("  ") for line in lines)
    assert " ".join(line.strip() for line in lines) == TEXT.strip()


def test_a_path_that_is_too_long_stays_whole_to_be_copied():
    path = "runs/" + "b2_9f31c2_0007_shake" * 3
    assert path in printed(f"report: {path}", width=40, force_terminal=True, color_system=None).splitlines()
