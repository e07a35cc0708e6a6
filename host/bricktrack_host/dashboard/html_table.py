"""Tables as HTML, for panes that are rewritten as units answer; everything that units say is escaped."""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

MOST_LISTED = 100


@dataclass(frozen=True, slots=True)
class Bar:
    """A cell that shows how much is done, 0 to 1, with words beside it."""

    share: float
    label: str
    words: str


Cell = str | Bar


def html_table(heads: Sequence[str], lines: Sequence[Sequence[Cell]]) -> str:
    """Return lines as a table, the first `MOST_LISTED` of them; nothing without lines."""
    if not lines:
        return ""
    head = "".join(f'<th scope="col">{escape(h)}</th>' for h in heads)
    body = "".join("<tr>" + "".join(map(_cell, line)) + "</tr>" for line in lines[:MOST_LISTED])
    more = f'<p class="hint">and {len(lines) - MOST_LISTED} more</p>' if len(lines) > MOST_LISTED else ""
    return f'<table class="lines"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{more}'


def _cell(cell: Cell) -> str:
    if isinstance(cell, str):
        return f"<td>{escape(cell)}</td>"
    return (
        f'<td class="with-bar"><progress max="1" value="{cell.share:.3f}" aria-label="{escape(cell.label)}">'
        f"</progress> {escape(cell.words)}</td>"
    )
