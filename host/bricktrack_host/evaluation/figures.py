"""The evaluation's pictures, after the source paper's figure 10, and its page."""

import base64
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from bricktrack_common.arrays import FloatArray
from bricktrack_host.evaluation.scores import SweepScore

_STYLE: Any = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e3e6e9",
    "axes.edgecolor": "#8b929b",
    "axes.labelcolor": "#22272e",
    "svg.hashsalt": "bricktrack",
}
_COLOURS = ("#1f6feb", "#b35900", "#2f6b45")

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ title }}</title><style>
body { margin: 0; color: #22272e; font: 15px/1.5 system-ui, "Segoe UI", Roboto, Arial, sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 2rem 1.5rem 4rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.1rem; margin-top: 2.2rem; }
.soft, figcaption { color: #5b616b; font-size: .9rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .92rem; margin: .8rem 0; }
th, td { padding: .3rem 1rem .3rem 0; border-bottom: 1px solid #dcdfe3; text-align: right; }
th:first-child, td:first-child { text-align: left; }
figure { margin: 1rem 0; } img { width: 100%; height: auto; }
</style></head><body><main>
<h1>{{ title }}</h1><p class="soft">{{ subtitle }}</p>
{% for t in tables %}<h2>{{ t.title }}</h2><table>
<tr>{% for c in t.columns %}<th>{{ c }}</th>{% endfor %}</tr>
{% for row in t.rows %}<tr>{% for cell in row %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</table>{% endfor %}
{% for line in lines %}<p>{{ line }}</p>{% endfor %}
{% for f in figures %}<figure><img src="{{ f.uri }}" alt="{{ f.caption }}">
<figcaption>{{ f.caption }}</figcaption></figure>
{% endfor %}</main></body></html>
"""


def errors_figure(scores: Sequence[SweepScore]) -> Figure:
    """Return errors along each sweep: position left, rotation right, with twice the bound as a band."""
    with rc_context(_STYLE):
        fig = Figure(figsize=(10.4, 2.1 * len(scores) + 0.7), layout="constrained")
        axes: Any = fig.subplots(len(scores), 2, squeeze=False)
        for row, score in zip(axes, scores, strict=True):
            _panel(row[0], score, score.error_mm, score.bound_mm, "error, mm")
            _panel(row[1], score, score.error_deg, score.bound_deg, "error, deg")
            row[0].set_title(score.sweep.name, loc="left", fontsize=9, fontweight="bold")
            for ax in row:
                ax.set_xlabel(
                    f"true {'angle' if score.sweep.unit == 'deg' else 'displacement'}, {score.sweep.unit}"
                )
        handles, labels = axes[0][0].get_legend_handles_labels()
        fig.legend(handles, labels, loc="outside upper right", ncols=4, frameon=False)
        return fig


def _panel(ax: Any, score: SweepScore, error: FloatArray, bound: FloatArray, label: str) -> None:
    x = score.sweep.step
    widest = (
        np.nanmax(np.where(np.isfinite(bound), bound, np.nan), axis=1) if np.isfinite(bound).any() else None
    )
    if widest is not None:
        ax.fill_between(
            x, -2 * widest, 2 * widest, color="#eceff2", lw=0, label="twice the bound, widest axis"
        )
    onwards = bool((np.diff(x) > 0).all())  # places in no order are points, not a line
    for k, (name, colour) in enumerate(zip("xyz", _COLOURS, strict=True)):
        style = {"color": colour, "lw": 1.0 if onwards else 0.0, "marker": ".", "ms": 3 if onwards else 7}
        ax.plot(x, error[:, k], **style, label=f"{name} (left: along, right: about)")
    ax.axhline(0, color="#8b929b", lw=0.6)
    ax.set_ylabel(label)


def write_page(
    path: Path,
    *,
    title: str,
    subtitle: str,
    tables: Sequence[dict[str, Any]],
    lines: Sequence[str],
    figures: Sequence[tuple[Figure, str]],
) -> list[Path]:
    """Write a page that needs nothing beside it, and each figure as PNG beside it; return all paths."""
    embedded, written = [], [path]
    for k, (figure, caption) in enumerate(figures):
        with rc_context(_STYLE):
            svg = io.StringIO()
            figure.savefig(svg, format="svg", metadata={"Date": None})
            png = path.with_name(f"{path.stem}_{k + 1}.png")
            figure.savefig(png, dpi=130)
        written.append(png)
        uri = "data:image/svg+xml;base64," + base64.b64encode(svg.getvalue().encode()).decode()
        embedded.append({"uri": uri, "caption": caption})
    page = jinja2.Environment(autoescape=True).from_string(_PAGE)
    text = page.render(title=title, subtitle=subtitle, tables=tables, lines=lines, figures=embedded)
    path.write_text(text, encoding="utf-8")
    return written
