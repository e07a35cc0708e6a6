"""The pane of the last test's results, for each unit and each assembly."""

from pathlib import Path

from nicegui import ui

from bricktrack_host.dashboard.last_test import assembly_rows, find_last_test, unit_rows

REPORT_PATH = "/last-test/report"


@ui.refreshable
def last_test_pane(tests_folder: Path | None) -> None:
    """Show what the newest test says; its button looks again."""
    last = find_last_test(tests_folder) if tests_folder is not None else None
    with ui.row().classes("bar"):
        if last is None:
            ui.label("No test was combined yet: 'bricktrack test report NAME' does.")
        else:
            simulated = " (simulated)" if last.summary is not None and last.summary.simulated else ""
            ui.label(f"{last.name}{simulated}").classes("strong")
            if last.report is not None:
                ui.link("Report", REPORT_PATH, new_tab=True)
        ui.space()
        ui.button("Look again", icon="refresh", on_click=last_test_pane.refresh).props("flat")
    if last is None:
        return
    if last.summary is None:
        ui.label(last.error).classes("bad")
        return
    for problem in last.summary.problems:
        ui.label(problem).classes("bad")
    heads = {"assembly": "assembly", "component": "component", "peak_mm": "largest, mm",
             "peak_deg": "largest, deg", "verdict": "verdict"}  # fmt: skip
    _table("Assemblies: largest motion from rest, seen from the base", heads, assembly_rows(last.summary))
    heads = {"unit": "unit", "run": "run", "edges": "edges", "verdict": "verdict"}
    _table("Units", heads, unit_rows(last.summary))


def _table(title: str, heads: dict[str, str], rows: list[dict[str, object]]) -> None:
    if not rows:
        return
    columns = [
        {"name": k, "label": label, "field": k, "sortable": True, "align": "left",
         "style": "white-space:normal"}
        for k, label in heads.items()
    ]  # fmt: skip
    numbered = [{"id": i, **row} for i, row in enumerate(rows)]
    ui.table(rows=numbered, columns=columns, row_key="id", title=title, pagination=50).classes("wide").props(
        "dense flat bordered"
    )
