"""The page itself: plan, table, orders, checks, aim, and the last test; one instance for each browser."""

import json
import re
from collections.abc import Callable
from pathlib import Path

from nicegui import events, run, ui

from bricktrack_common.errors import BricktrackError
from bricktrack_host.campaign.test_plan import NAME_PATTERN
from bricktrack_host.dashboard.aim_pane import AimPane
from bricktrack_host.dashboard.checks_pane import ChecksPane
from bricktrack_host.dashboard.fleet_watch import FleetWatch
from bricktrack_host.dashboard.last_test_pane import last_test_pane
from bricktrack_host.dashboard.orders import Order, OrderDesk
from bricktrack_host.dashboard.orders_pane import OrdersPane
from bricktrack_host.dashboard.plan import plan_svg, state_css
from bricktrack_host.dashboard.unit_view import STATES, UnitView
from bricktrack_host.transfer.fleet_config import UnitConfig

REFRESH_S = 0.2
"""How often a browser is told what changed."""
_HERE = Path(__file__).parent
HEARD_EVERY_S = 1.0
"""How often it is told that the server is there; see ``page.js``."""


class ControlPage:
    """What one browser shows; built in the context of its page.

    Parameters
    ----------
    lab : Path or None
        Folder of the fleet file; `None` without one.
    """

    def __init__(self, units: list[UnitConfig], watch: FleetWatch, desk: OrderDesk, lab: Path | None) -> None:
        self._units, self._watch, self._desk = units, watch, desk
        self._chosen: list[str] = []
        self._order_version = -1
        self._version, changed = watch.changes_since(-1)
        self._views = {view.name: view for view in changed}
        style, script = ((_HERE / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
        ui.add_head_html(f"<style>{style}{state_css()}</style><script>{script}</script>")
        # The plan is in the document that is sent, so it is painted before any script has loaded.
        ui.add_body_html(
            '<div id="early"><div class="top"><h1>bricktrack</h1></div><div class="panes">'
            f'<section class="card">{plan_svg(units, self._views)}</section></div></div>{_BANNER}'
        )
        self._build_top()
        with ui.element("div").classes("panes"):
            with ui.element("section").classes("card"):
                self._plan = ui.element("div").props("id=plan-slot")
                self._plan.on("click", self._tile_clicked, js_handler=_TILE_HANDLER)
                for key in ("keydown.enter", "keydown.space.prevent"):
                    self._plan.on(key, self._tile_clicked, js_handler=_TILE_HANDLER)
                self._hint = ui.label().classes("hint")
            with ui.element("section").classes("card"):
                self._build_tabs(lab)
        self._show_counts()
        self._show_chosen()
        ui.run_javascript("bricktrack.adoptPlan()")
        ui.timer(REFRESH_S, self._refresh)
        ui.timer(HEARD_EVERY_S, lambda: ui.run_javascript("bricktrack.heard()"))

    def _build_top(self) -> None:
        with ui.row().classes("top"):
            ui.html("<h1>bricktrack</h1>", sanitize=False)
            self._chips = ui.row().classes("bar")
            ui.space()
            with ui.row().classes("bar"):
                self._arm_button = ui.button("Arm", icon="sensors", on_click=self._open_arm)
                self._disarm_button = ui.button("Disarm", icon="stop", on_click=self._disarm_meant)
                self._pull_button = ui.button("Pull runs", icon="download", on_click=self._pull)
            for button in (self._disarm_button, self._pull_button):
                button.props("color=grey-8")
            if self._desk.runs_folder is None:
                self._pull_button.disable()
                self._pull_button.tooltip("Needs the folder that a fleet file names")
        with ui.row().classes("bar order") as self._order_row:
            self._order_words = ui.label().classes("order-words").props("role=status")
            self._order_bar = ui.linear_progress(show_value=False).classes("order-bar")
            self._order_bar.props('aria-label="How much of the order is done"')
        self._order_row.set_visibility(False)
        with ui.dialog() as self._arm_dialog, ui.card():
            self._arm_title = ui.label().classes("big")
            self._arm_doubt = ui.label().classes("bad")
            self._label = ui.input(
                "Label of the runs",
                placeholder="shake-07",
                validation={"letters, digits and hyphens, 32 at most": _is_label},
            ).classes("field")
            self._duration = ui.number("Seconds, if not the units' own", min=0.1, max=600).classes("field")
            with ui.row():
                ui.button("Arm", on_click=self._arm)
                ui.button("Cancel", on_click=self._arm_dialog.close).props("flat")

        with ui.dialog() as self._disarm_dialog, ui.card():
            self._disarm_title = ui.label().classes("big")
            self._disarm_doubt = ui.label().classes("bad")
            with ui.row():
                ui.button("Disarm them", on_click=self._disarm)
                ui.button("Keep them", on_click=self._disarm_dialog.close).props("flat")

    def _build_tabs(self, lab: Path | None) -> None:
        with ui.tabs().props("dense align=left inline-label").classes("wide") as tabs:
            units_tab, checks_tab = ui.tab("Units"), ui.tab("Checks")
            aim_tab, orders_tab, test_tab = ui.tab("Aim"), ui.tab("Orders"), ui.tab("Last test")
        with ui.tab_panels(tabs, value=units_tab).classes("wide").props("keep-alive"):
            with ui.tab_panel(units_tab).classes("pane"):
                self._build_table()
            with ui.tab_panel(checks_tab).classes("pane"):
                self._checks = ChecksPane()
                self._checks.show(self._views.values())
            with ui.tab_panel(aim_tab).classes("pane"):
                self._aim = AimPane([u.name for u in self._units], self._desk)
            with ui.tab_panel(orders_tab).classes("pane"):
                self._orders = OrdersPane()
            with ui.tab_panel(test_tab).classes("pane"):
                last_test_pane(lab)

    def _build_table(self) -> None:
        self._grid: ui.aggrid
        with ui.row().classes("bar"):
            self._filter = ui.input(
                placeholder="Filter: a name, a state, a word", on_change=lambda e: self._set_filter(e.value)
            )
            self._filter.props("dense outlined clearable").classes("grow")
            shown = ui.button(
                "Choose all shown", on_click=lambda: self._grid.run_grid_method("selectAll", "filtered")
            )
            shown.props('aria-label="All shown: choose these units"')
            none = ui.button("Choose none", on_click=lambda: self._grid.run_grid_method("deselectAll"))
            none.props("flat")
            none.props('aria-label="None: choose no unit"')
        column = {"sortable": True, "filter": True, "resizable": True}
        self._grid = ui.aggrid(
            {
                "columnDefs": [
                    {"field": "name", "headerName": "Unit", "width": 110, "pinned": "left"},
                    {"field": "state", "headerName": "State", "width": 110},
                    {"field": "note", "headerName": "Note", "minWidth": 250, "flex": 1},
                    {"field": "n_runs", "headerName": "Runs", "width": 85, "filter": "agNumberColumnFilter"},
                    {"field": "n_to_pull", "headerName": "To pull", "width": 95,
                     "filter": "agNumberColumnFilter"},
                    {"field": "free_gb", "headerName": "Free, GB", "width": 105,
                     "filter": "agNumberColumnFilter"},
                    {"field": "temperature", "headerName": "°C", "width": 80,
                     "filter": "agNumberColumnFilter"},
                    {"field": "run_id", "headerName": "Run", "width": 190},
                ],
                "defaultColDef": column,
                "rowData": [_row(view) for view in self._views.values()],
                "rowSelection": {"mode": "multiRow", "enableClickSelection": False},
                ":getRowId": "params => params.data.name",
                "rowHeight": 44,
            },
            auto_size_columns=False,
        ).classes("units-grid")  # fmt: skip
        self._grid.on(
            "selectionChanged",
            self._selection_changed,
            js_handler=f"() => emit(getElement({self._grid.id}).api.getSelectedRows().map(row => row.name))",
        )

    def _refresh(self) -> None:
        """Tell the browser what changed since it was told last."""
        self._version, changed = self._watch.changes_since(self._version)
        if changed:
            told = [
                (v.name, v.state, STATES[v.state].letter)
                for v in changed
                if self._views[v.name].state != v.state
            ]
            self._views |= {view.name: view for view in changed}
            if told:
                ui.run_javascript(f"bricktrack.setStates({json.dumps(told)})")
            self._grid.run_grid_method("applyTransaction", {"update": [_row(view) for view in changed]})
            self._show_counts()
            self._checks.show(self._views.values())
        if self._order_version != self._desk.version:
            self._order_version = self._desk.version
            self._show_order()

    def _show_counts(self) -> None:
        states = [view.state for view in self._views.values()]
        self._chips.clear()
        with self._chips:
            for state, look in STATES.items():
                n = states.count(state)
                if not n:
                    continue
                chip = (
                    ui.element("button")
                    .classes("chip")
                    .props(
                        f'data-state="{state}" type="button" '
                        f'aria-label="{n} {state}: {look.meaning}. Show these in the table"'
                    )
                )
                chip.on("click", lambda s=state: self._filter.set_value(s))
                with chip:
                    ui.label(f"{look.letter}  {n} {state}")
                    ui.tooltip(f"{look.meaning}; click to filter")
            if any(view.simulated for view in self._views.values()):
                ui.label("simulated units").classes("told")

    def _show_order(self) -> None:
        order = self._desk.current
        if order is None:
            return
        self._order_row.set_visibility(True)
        self._order_words.text = order.words
        self._order_bar.value = order.share
        is_under_way = order.ended_s is None
        for button in (self._arm_button, self._disarm_button):
            button.set_enabled(not is_under_way)
        self._pull_button.set_enabled(not is_under_way and self._desk.runs_folder is not None)
        self._orders.show(order)

    def _set_filter(self, text: str | None) -> None:
        self._grid.run_grid_method("setGridOption", "quickFilterText", text or "")

    def _tile_clicked(self, event: events.GenericEventArguments) -> None:
        name = str(event.args)
        if name not in self._views:
            return
        self._grid.run_row_method(name, "setSelected", name not in self._chosen)
        self._aim.show_unit(name)

    def _selection_changed(self, event: events.GenericEventArguments) -> None:
        self._chosen = [name for name in event.args if name in self._views]
        ui.run_javascript(f"bricktrack.setChosen({json.dumps(self._chosen)})")
        self._show_chosen()

    def _show_chosen(self) -> None:
        n = len(self._chosen)
        if n == 1:
            self._hint.text = f"Orders go to {self._chosen[0]} alone."
        elif n:
            self._hint.text = f"Orders go to the {n} units chosen."
        else:
            self._hint.text = f"Orders go to all {len(self._views)} units. Touch a unit to choose it."

    def _meant(self) -> list[str]:
        """Return the units that an order goes to, in the fleet's order: those chosen, or all."""
        chosen = set(self._chosen)
        return [name for name in self._views if name in chosen or not chosen]

    def _open_arm(self) -> None:
        meant = self._meant()
        self._arm_title.text = f"Arm {self._count(meant)} for the next first edge?"
        refusing = [name for name in meant if self._views[name].state != "idle"]
        self._arm_doubt.text = f"Not idle, so not to be armed: {_some(refusing)}" if refusing else ""
        self._arm_dialog.open()

    def _count(self, names: list[str]) -> str:
        if len(names) == 1:
            return names[0]
        return f"{'all ' if len(names) == len(self._views) else ''}{len(names)} units"

    async def _arm(self) -> None:
        if not self._label.validate():
            return
        self._arm_dialog.close()
        duration_s = self._duration.value
        await self._order(
            lambda: self._desk.arm(self._meant(), (self._label.value or "").strip(), duration_s)
        )

    async def _disarm_meant(self) -> None:
        """Disarm the units chosen; all of them, or one that records, only after asking: it ends a test."""
        meant = self._meant()
        recording = [name for name in meant if self._views[name].state in ("recording", "saving")]
        if self._chosen and not recording:
            await self._disarm()
            return
        self._disarm_title.text = f"Disarm {self._count(meant)}?"
        self._disarm_doubt.text = f"Their runs end now: {_some(recording)}" if recording else ""
        self._disarm_dialog.open()

    async def _disarm(self) -> None:
        self._disarm_dialog.close()
        await self._order(lambda: self._desk.disarm(self._meant()))

    async def _pull(self) -> None:
        await self._order(lambda: self._desk.pull(self._meant()))

    async def _order(self, give: Callable[[], Order]) -> None:
        try:
            order = await run.io_bound(give)
        except BricktrackError as e:
            ui.notify(str(e), type="negative", multi_line=True, timeout=10_000)
            return
        if order is None:  # the page is being closed
            return
        good = not order.refused
        words = order.words if good else f"{order.words}. The tab 'Orders' says which"
        ui.notify(words, type="positive" if good else "negative", multi_line=True, timeout=8_000)


_BANNER = (
    '<div id="lost" role="alert" hidden><span></span>'
    '<button type="button" onclick="location.reload()">Reload the page</button></div>'
)
_TILE_HANDLER = '(e) => { const t = e.target.closest(".unit"); if (t) emit(t.dataset.unit); }'


def _some(names: list[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _is_label(text: str | None) -> bool:
    return not text or re.fullmatch(NAME_PATTERN, text.strip()) is not None


def _row(view: UnitView) -> dict[str, object]:
    return {
        "name": view.name,
        "state": view.state,
        "n_runs": view.n_runs,
        "n_to_pull": view.n_to_pull,
        "free_gb": view.free_gb,
        "temperature": view.temperature_degc,
        "run_id": view.run_id,
        "note": view.note,
    }
