"""The commands that pages of the documentation tell to type, and a hand that types them."""

import re
import shlex
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from typer.testing import CliRunner

from bricktrack_device.cli import app as device_app
from bricktrack_host.cli.main import app as host_app

ROOT = Path(__file__).resolve().parents[2]

# A fenced block, whatever it is indented by; or a span of code within a line.
FENCE = re.compile(r"^( *)(`{3,})([^\n]*)\n(.*?)^\1\2`* *$", flags=re.M | re.S)
_INDENTED = re.compile(r"^ {4,}(?:\$ )?(bricktrackd? .*)$", flags=re.M)
_SPAN = re.compile(r"(?<!`)`(bricktrackd? [^`]+)`(?!`)")
PREFIX = re.compile(r"^(\$ )?(sudo (-u \w+ )?)?(/[\w./-]*/)?(?=bricktrackd? )")


@dataclass(frozen=True)
class Command:
    """A command as a page gives it; ``whole`` if it is meant to be typed as it stands."""

    page: str
    text: str
    whole: bool


def commands_on(page: str, text: str) -> list[Command]:
    """Return the commands of a page: those of its blocks, and those named in its sentences."""
    found = []
    for fence in FENCE.finditer(text):
        language, block = fence[3].strip(), fence[4].replace("\\\n", " ")
        if language in {"console", "shell", "sh", "bash"}:
            lines = [PREFIX.sub("", line.strip()) for line in block.splitlines()]
            found += [Command(page, line, True) for line in lines if re.match(r"bricktrackd? \S", line)]
    rest = FENCE.sub("", text)
    found += [Command(page, match[1], True) for match in _INDENTED.finditer(rest)]
    found += [Command(page, " ".join(m[1].split()), False) for m in _SPAN.finditer(rest)]
    return found


def words_of(text: str) -> list[str]:
    """Return the words of one command: to the first pipe, comment or other end that a shell sees."""
    lexer = shlex.shlex(text, posix=True, punctuation_chars="|;&<>()")
    lexer.whitespace_split = True
    lexer.commenters = "#"
    words = []
    for word in lexer:
        if re.fullmatch(r"[|;&<>()]+", word):
            break
        words.append(word)
    return words


def typed_on(page: str) -> list[list[str]]:
    """Return the words of every whole command on a page, given by its path from the repository's root."""
    return [words_of(c.text) for c in commands_on(page, (ROOT / page).read_text()) if c.whole]


def type_all(
    page: str,
    *,
    but: Collection[str] = (),
    instead: Mapping[str, str] | None = None,
    before: Mapping[str, Callable[[], object]] | None = None,
) -> dict[str, str]:
    """Run a how-to page's commands in order, in the working folder, and return what each printed.

    Parameters
    ----------
    page : str
        Its name.
    but : collection of str
        Commands that are left out, by a word of theirs or whole.
    instead : mapping of str to str
        Words of the page that are others here.
    before : mapping of str to callable
        What is done before a command that has this word.
    """
    typed = {" ".join(words): words for words in typed_on(f"docs/how-to/{page}")}
    said = {word for line, words in typed.items() for word in (line, *words)}
    unknown = {*but, *(instead or {}), *(before or {})} - said
    assert not unknown, f"{page} does not say {unknown} any more"
    printed = {}
    for line, words in typed.items():
        if {line, *words} & set(but):
            continue
        for word, do in (before or {}).items():
            if word in words:
                do()
        named = [(instead or {}).get(word, word) for word in words]
        app = {"bricktrack": host_app, "bricktrackd": device_app}[named[0]]
        arguments = [name for word in named[1:] for name in _expanded(word)]
        done = CliRunner().invoke(app, arguments, env={"COLUMNS": "160", "NO_COLOR": "1"})
        assert done.exit_code == 0, f"{page}: {line}\n{done.output}\n{done.exception}"
        printed[line] = done.output
    return printed


def _expanded(word: str) -> list[str]:
    """Return what a shell makes of a word: the files of a pattern, where there are any."""
    return ("*" in word and sorted(str(path) for path in Path().glob(word))) or [word]
