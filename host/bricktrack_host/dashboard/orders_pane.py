"""The pane of the order under way, or the last one: what each unit said, and how far its runs are pulled."""

from html import escape

from nicegui import ui

from bricktrack_host.dashboard.html_table import Bar, html_table
from bricktrack_host.dashboard.orders import Order, OrderLine


class OrdersPane:
    """Each unit's answer, those that did not do as told first; built where it is shown."""

    def __init__(self) -> None:
        self._lines = ui.html('<p class="hint">No order was given yet.</p>', sanitize=False).classes("scroll")

    def show(self, order: Order) -> None:
        """Show how far an order is."""
        lines = [(line.unit, line.level, _says(line)) for line in order.lines()]
        self._lines.content = f'<p class="strong">{escape(order.words)}</p>' + html_table(
            ("unit", "state", "says"), lines
        )


def _says(line: OrderLine) -> str | Bar:
    return line.words if line.share is None else Bar(line.share, f"pulled from {line.unit}", line.words)
