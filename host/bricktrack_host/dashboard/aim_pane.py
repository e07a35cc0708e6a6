"""The pane that a camera is aimed and focused by: a still at a time, or one after the other."""

import asyncio
import math

from nicegui import run, ui

from bricktrack_common.errors import BricktrackError
from bricktrack_host.dashboard.aim_view import NEAR_BORDER_PX, AimView, aim_view
from bricktrack_host.dashboard.orders import OrderDesk

_PAUSE_S = 0.2  # a unit that refuses is not asked without pause


class AimPane:
    """Picture, focus, exposure and the LEDs' room to the border; built where it is shown."""

    def __init__(self, names: list[str], desk: OrderDesk) -> None:
        self._desk = desk
        self._under_way = False
        with ui.row().classes("bar"):
            self._unit = ui.select(names, value=names[0], label="Unit", with_input=True).classes("field")
            self._take = ui.button("Take a picture", icon="photo_camera", on_click=self._take_one)
            self._keep = ui.switch("Keep taking", on_change=self._keep_taking)
            self._spinner = ui.spinner(size="24px")
            self._spinner.set_visibility(False)
        self._words = ui.label("The unit must be idle; starting its camera takes seconds.").classes("strong")
        self._advice = ui.label().classes("bad")
        self._picture = ui.image().classes("aim")
        with ui.row().classes("details") as self._details:
            with ui.column().classes("half"):
                self._exposure = ui.label().classes("hint")
                self._histogram = ui.html("", sanitize=False).classes("wide")
            self._leds = ui.table(rows=[], columns=_COLUMNS, row_key="number").classes("half")
            self._leds.props("dense flat bordered")
        self._picture.set_visibility(False)
        self._details.set_visibility(False)

    def show_unit(self, name: str) -> None:
        """Turn to another unit."""
        self._unit.value = name

    async def _take_one(self) -> None:
        if not self._under_way:
            await self._look()

    async def _keep_taking(self) -> None:
        client = ui.context.client
        while self._keep.value and client.has_socket_connection and not self._under_way:
            if not await self._look():
                self._keep.value = False
            await asyncio.sleep(_PAUSE_S)

    async def _look(self) -> bool:
        """Take one picture and show it; tell whether it came."""
        name = str(self._unit.value)
        self._under_way = True
        self._spinner.set_visibility(True)
        self._take.disable()
        try:
            seen = await run.io_bound(self._fetch, name)
            if seen is None:  # the page is being closed
                return False
            self._show(name, seen)
        except BricktrackError as e:
            self._words.text = f"{name}: no picture"
            self._advice.text = str(e)
            self._picture.set_visibility(False)
            self._details.set_visibility(False)
            return False
        finally:
            self._under_way = False
            self._spinner.set_visibility(False)
            self._take.enable()
        return True

    def _fetch(self, name: str) -> AimView:
        with self._desk.dialer.reach(self._desk.unit(name)) as contact:
            image, data = contact.client.still(encoding="png")
        return aim_view(image, data, source=name)

    def _show(self, name: str, seen: AimView) -> None:
        focus = "" if math.isnan(seen.focus_px) else f", edges {seen.focus_px:.1f} px wide: less is sharper"
        others = f", {seen.n_others} other lights" if seen.n_others else ""
        simulated = " (simulated)" if seen.simulated else ""
        self._words.text = f"{name}{simulated}: {len(seen.leds)} LEDs{focus}{others}"
        self._advice.text = "\n".join(seen.advice)
        self._picture.set_source(seen.picture_uri)
        self._exposure.text = (
            f"{seen.exposure_us / 1000:g} ms, gain {seen.gain:.2f}; {100 * seen.full_share:.2f} % of the "
            "pixels at "
            "full level"
        )
        self._histogram.content = seen.histogram_svg
        self._leds.rows = [
            {
                "number": led.number,
                "edge": "-" if math.isnan(led.edge_px) else f"{led.edge_px:.1f}",
                "left": round(led.left_px),
                "top": round(led.top_px),
                "right": round(led.right_px),
                "bottom": round(led.bottom_px),
                "border": "near" if led.nearest_px < NEAR_BORDER_PX else "ok",
            }
            for led in seen.leds
        ]
        self._picture.set_visibility(True)
        self._details.set_visibility(True)


_COLUMNS = [
    {"name": key, "label": label, "field": key, "sortable": True, "align": "right"}
    for key, label in (
        ("number", "LED"), ("edge", "edge, px"), ("left", "left, px"), ("top", "top, px"),
        ("right", "right, px"), ("bottom", "bottom, px"), ("border", "border"),
    )
]  # fmt: skip
