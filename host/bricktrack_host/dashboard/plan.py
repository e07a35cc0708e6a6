"""The array drawn as a plan: where each unit stands, as a tile with its state's colour and letter."""

import math
from html import escape

from bricktrack_host.dashboard.unit_view import STATES, UnitView
from bricktrack_host.transfer.fleet_config import UnitConfig

_TILE = 40.0
_PITCH = 46.0


def places(units: list[UnitConfig]) -> tuple[list[tuple[float, float]], float, float]:
    """Return the centre of each unit's tile, x to the right and y down, and the plan's width and height.

    With a position for every unit the plan is to scale, no two tiles closer than they are wide as long as
    their positions differ; otherwise it is a grid in the fleet's order.
    """
    known = [u.position_mm for u in units if u.position_mm is not None]
    if len(known) < len(units) or len(set(known)) < len(known):
        n_columns = max(math.ceil(math.sqrt(len(units) * 1.25)), 1)
        at = [((i % n_columns + 0.5) * _PITCH, (i // n_columns + 0.5) * _PITCH) for i in range(len(units))]
        return at, n_columns * _PITCH, math.ceil(len(units) / n_columns) * _PITCH
    left, top = min(x for x, _ in known), max(y for _, y in known)
    scale = _PITCH / _closest(known)
    at = [((x - left) * scale + _PITCH / 2, (top - y) * scale + _PITCH / 2) for x, y in known]
    return at, max(x for x, _ in at) + _PITCH / 2, max(y for _, y in at) + _PITCH / 2


def _closest(points: list[tuple[float, float]]) -> float:
    """Return the least distance along x or y, the larger of both, of two points; 1 for a single one."""
    ordered = sorted(points)
    best = math.inf
    for i, (x, y) in enumerate(ordered):
        for other_x, other_y in ordered[i + 1 :]:
            if other_x - x >= best:
                break
            best = min(best, max(other_x - x, abs(other_y - y)))
    return best if math.isfinite(best) else 1.0


def plan_svg(units: list[UnitConfig], views: dict[str, UnitView]) -> str:
    """Return the plan as SVG; ``page.js`` keeps each tile's state, and which of them the tab key goes to."""
    at, width, height = places(units)
    tiles = "".join(
        _tile(unit.name, views[unit.name].state, x, y, has_tab=i == 0)
        for i, (unit, (x, y)) in enumerate(zip(units, at, strict=True))
    )
    return (
        f'<svg id="plan" viewBox="0 0 {width:.0f} {height:.0f}" role="group"'
        f' aria-label="Plan of the array; arrow keys go from unit to unit, space chooses">{tiles}</svg>'
    )


def _tile(name: str, state: str, x: float, y: float, *, has_tab: bool) -> str:
    shown = name if len(name) <= 8 else "…" + name[-7:]
    half = _TILE / 2
    words = f"{name}: {state}"
    return (
        f'<g class="unit" data-unit="{escape(name)}" data-state="{state}" role="button"'
        f' tabindex="{0 if has_tab else -1}" aria-pressed="false" aria-label="{escape(words)}"'
        f' transform="translate({x:.1f} {y:.1f})">'
        f"<title>{escape(words)}</title>"
        f'<rect x="{-half}" y="{-half}" width="{_TILE}" height="{_TILE}" rx="6"/>'
        f'<text class="letter" y="1">{STATES[state].letter}</text>'
        f'<text class="name" y="15">{escape(shown)}</text></g>'
    )


def state_css() -> str:
    """Return the style rules of the states, for tiles and for words."""
    rules = []
    for state, look in STATES.items():
        chosen = f'[data-state="{state}"]'
        rules.append(f".unit{chosen} rect{{fill:{look.fill}}}")
        rules.append(f".unit{chosen} text{{fill:{look.ink}}}")
        rules.append(f".chip{chosen}{{background:{look.fill};color:{look.ink}}}")
    rules.append('.unit[data-state="no answer"] rect{stroke:#1b1b1b;stroke-dasharray:4 3}')
    return "\n".join(rules)
