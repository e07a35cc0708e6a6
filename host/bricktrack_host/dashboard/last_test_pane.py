"""The pane of the last test's results, for each unit and each assembly."""

from pathlib import Path

from nicegui import ui

from bricktrack_host.dashboard.last_test import (
    LastTest,
    assembly_rows,
    find_last_test,
    report_address,
    unit_rows,
)
from bricktrack_host.reporting.combined_report import verdict

TESTS_FOLDER = "tests"
_ROWS_A_PAGE = 50
_LINK = (
    '<q-td :props="props"><a v-if="props.value" class="link" :href="props.value" target="_blank" '
    ":aria-label=\"'Report of ' + props.row.run\">open</a><span v-else>-</span></q-td>"
)
_VERDICT = (
    "<q-td :props=\"props\"><span :class=\"props.value === 'good' ? 'good' : 'bad'\">"
    "{{ props.value }}</span></q-td>"
)


@ui.refreshable
def last_test_pane(lab: Path | None) -> None:
    """Show what the newest test of a laboratory's folder says; its button looks again."""
    last = find_last_test(lab / TESTS_FOLDER) if lab is not None else None
    with ui.row().classes("bar"):
        if last is None:
            ui.label("No test was combined yet: 'bricktrack test report NAME' does.")
        else:
            simulated = " (simulated)" if last.summary is not None and last.summary.simulated else ""
            ui.label(f"{last.name}{simulated}").classes("strong")
            address = report_address(lab, last.report) if lab is not None else None
            if address is not None:
                ui.link("Report", address, new_tab=True).classes("link")
        ui.space()
        ui.button("Look again", icon="refresh", on_click=last_test_pane.refresh).props("flat")
    if last is not None and lab is not None:
        _show(last, lab)


def _show(last: LastTest, lab: Path) -> None:
    if last.summary is None:
        ui.label(last.error).classes("bad")
        return
    line, mood = verdict(last.summary)
    ui.label(line).classes(mood)
    for problem in last.summary.problems:
        ui.label(problem).classes("bad")
    _table(
        "Assemblies: largest motion from rest, seen from the base",
        {"assembly": "assembly", "component": "component", "peak_mm": "largest, mm",
         "peak_deg": "largest, deg", "loops": "loop gapes, mm rms", "verdict": "verdict"},
        assembly_rows(last.summary),
    )  # fmt: skip
    _table(
        "Units",
        {"unit": "unit", "run": "run", "edges": "edges", "poses": "poses", "sd_mm": "stated sd, mm",
         "verdict": "verdict", "report": "report"},
        unit_rows(last, lab),
    )  # fmt: skip


def _table(title: str, heads: dict[str, str], rows: list[dict[str, object]]) -> None:
    if not rows:
        return
    wraps = ("verdict", "edges", "loops")
    columns = [
        {"name": k, "label": label, "field": k, "sortable": k != "report", "align": "left",
         "style": "white-space:normal" if k in wraps else "white-space:nowrap"}
        for k, label in heads.items()
    ]  # fmt: skip
    numbered = [{"id": i, **row} for i, row in enumerate(rows)]
    table = ui.table(rows=numbered, columns=columns, row_key="id", title=title, pagination=_ROWS_A_PAGE)
    table.classes("wide").props("dense flat bordered")
    if len(rows) <= _ROWS_A_PAGE:
        table.props("hide-pagination")
    table.add_slot("body-cell-verdict", _VERDICT)
    table.add_slot("body-cell-report", _LINK)
