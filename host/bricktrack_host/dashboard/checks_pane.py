"""The pane of the checks: what keeps units from recording, or makes their runs worse, and what mends it."""

from collections.abc import Collection

from nicegui import ui

from bricktrack_host.dashboard.html_table import html_table
from bricktrack_host.dashboard.unit_view import UnitView


class ChecksPane:
    """How many units pass, and a line for everything that is wrong; built where it is shown."""

    def __init__(self) -> None:
        self._words = ui.label().classes("strong")
        self._lines = ui.html("", sanitize=False).classes("scroll")

    def show(self, views: Collection[UnitView]) -> None:
        """Show how units are."""
        failing = [v for v in views if v.problems or v.state == "asking"]
        warned = [v for v in views if v.warnings and not v.problems]
        self._words.text = f"{len(views) - len(failing)} of {len(views)} units pass" + (
            f", {len(warned)} of them with a warning" if warned else ""
        )
        self._lines.content = html_table(("unit", "check", "because", "what to do"), check_lines(views))


def check_lines(views: Collection[UnitView]) -> list[tuple[str, str, str, str]]:
    """Return unit, level, words and remedy of everything that is wrong, what stops a unit first."""
    fails = [(v.name, "fails", words, remedy) for v in views for words, remedy in v.problems]
    return fails + [(v.name, "warning", words, remedy) for v in views for words, remedy in v.warnings]
