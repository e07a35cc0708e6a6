"""The commands that pages of the documentation tell to type."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

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
