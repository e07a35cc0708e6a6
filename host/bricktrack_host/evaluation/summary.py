"""The evaluation in rows: the paper's table with ours and the bound beside it, for people and as JSON."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.evaluation.scores import PAPER_RMS_MM, PAPER_WORST_ANGLE_DEG, SweepScore, rms

COLUMNS = ("", "steps", "x, mm", "y, mm", "z, mm", "rotation, deg", "NEES / 6")


def summary_rows(scores: Sequence[SweepScore], *, with_bound: bool) -> list[tuple[str, ...]]:
    """Return rows of text: each sweep, all of them, and the paper's."""
    rows = []
    for score in scores:
        rows.append(
            _row(
                score.sweep.name,
                f"{score.n_posed}/{len(score.sweep)}",
                score.rms_mm,
                score.rms_deg,
                nees_per_dof([score]),
            )
        )
        if with_bound:
            rows.append(_row("  bound", "", rms(score.bound_mm), _norm(rms(score.bound_deg))))
    rows.append(_row("all sweeps", "", *pooled(scores), nees_per_dof(scores)))
    if with_bound:
        every = np.concatenate([s.bound_mm for s in scores]), np.concatenate([s.bound_deg for s in scores])
        rows.append(_row("  bound", "", rms(every[0]), _norm(rms(every[1]))))
    paper = [f"{x:.4f}" for x in PAPER_RMS_MM]
    rows.append(("the paper, real camera", "", *paper, f"up to {PAPER_WORST_ANGLE_DEG}", "-"))
    return rows


def pooled(scores: Sequence[SweepScore]) -> tuple[FloatArray, float]:
    """Return root mean squares over all steps of all sweeps: x, y, z, mm, shape (3,), and rotation, deg."""
    return (
        rms(np.concatenate([s.error_mm for s in scores])),
        _norm(rms(np.concatenate([s.error_deg for s in scores]))),
    )


def nees_per_dof(scores: Sequence[SweepScore]) -> float:
    """Return the mean normalised error squared over six: 1 where the covariances are honest; NaN for none."""
    nees = np.concatenate([s.nees for s in scores])
    known = nees[np.isfinite(nees)]
    return float(known.mean() / 6) if known.size else float("nan")


def as_json(scores: Sequence[SweepScore]) -> dict[str, Any]:
    """Return the figures under names with units; `None` where there is no number."""
    mm, deg = pooled(scores)
    return {
        "sweeps": [
            {
                "name": s.sweep.name,
                "n_steps": len(s.sweep),
                "n_poses": s.n_posed,
                "rms_mm": _numbers(s.rms_mm),
                "bound_mm": _numbers(rms(s.bound_mm)),
                "rms_deg": _number(s.rms_deg),
                "bound_deg": _number(_norm(rms(s.bound_deg))),
                "nees_per_dof": _number(nees_per_dof([s])),
            }
            for s in scores
        ],
        "all": {
            "rms_mm": _numbers(mm),
            "rms_deg": _number(deg),
            "nees_per_dof": _number(nees_per_dof(scores)),
        },
        "paper": {"rms_mm": list(PAPER_RMS_MM), "worst_angle_deg": PAPER_WORST_ANGLE_DEG},
    }


def _row(name: str, steps: str, mm: FloatArray, deg: float, nees: float = float("nan")) -> tuple[str, ...]:
    return (name, steps, *(_text(x, 4) for x in mm), _text(deg, 4), _text(nees, 2))


def _text(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"


def _norm(values: FloatArray) -> float:
    return float(np.sqrt(np.sum(values**2)))


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _numbers(values: FloatArray) -> list[float | None]:
    return [_number(float(v)) for v in values]
