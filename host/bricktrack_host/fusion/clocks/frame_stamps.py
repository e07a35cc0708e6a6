"""Whether the frames' stamps can be right, by the camera's steady rate and by the inertial samples.

Stamps that step or scatter were made elsewhere, or edited, or the camera paused: where the brick turned on
both sides, the inertial samples tell which.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray, rows_of
from bricktrack_host.fusion.clocks.offset_change import (
    CLOCK_RATE_SD,
    SIGMA,
    OffsetChange,
    change_of_halves,
    errors_of,
    offset_change,
    offset_wander,
)
from bricktrack_host.fusion.clocks.stamp_regularity import (
    JITTER_NS,
    MIN_FRAMES,
    StampRegularity,
    StampStep,
    stamp_regularity,
)
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment, has_pose
from bricktrack_host.quality import PoseFlag
from bricktrack_host.tracks import ImuTrack, OpticalTrack

_WINDOW_S = 3.0  # of motion on either side of a step


@dataclass(frozen=True, slots=True, eq=False)
class StampCheck:
    """What can be said against the frames' stamps.

    Attributes
    ----------
    regularity : StampRegularity
    sd_ns : ndarray, shape (n_frames,), ns
        How unsure the instant of each frame is for it; zero where nothing speaks against the stamps.
    problems : tuple of str
        In words.
    is_contradicted : bool
        Whether the motion says that they are wrong somewhere, or those of the inertial samples.
    """

    regularity: StampRegularity
    sd_ns: FloatArray
    problems: tuple[str, ...]
    is_contradicted: bool


def check_stamps(
    stamps_ns: IntArray, optical: OpticalTrack, imu: ImuTrack | None, alignment: TimeAlignment | None
) -> StampCheck:
    """Return what the camera's steady rate and the inertial samples say against the frames' stamps.

    Which side of a step is wrong nothing tells, so all frames of the run are unsure by it; unless the motion
    says that the camera paused and the stamps are right.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n_frames,), ns, rising
        Of the frames of ``optical``.
    optical : OpticalTrack
    imu, alignment : ImuTrack and TimeAlignment, or None
        Without them the rate alone is looked at.
    """
    # A copy of another frame has no instant of its own.
    frame = np.flatnonzero(has_pose(optical) | ((optical.flags & int(PoseFlag.RESTAMPED)) == 0))
    n_frames, stamps_ns, optical = len(stamps_ns), stamps_ns[frame], rows_of(optical, frame)
    regularity = stamp_regularity(stamps_ns)
    problems = _words_on_rate(regularity, frame)
    sd_ns = np.hypot(regularity.stray_ns, regularity.jitter_ns if regularity.jitter_ns > JITTER_NS else 0.0)
    is_contradicted, level, levels_ns = False, 0.0, [0.0]
    ends = [0, *(s.frame for s in regularity.steps), len(stamps_ns)]
    for i, step in enumerate(regularity.steps, start=1):
        split_ns = int(optical.t_ns[step.frame])
        change = None
        if imu is not None and alignment is not None:
            change = offset_change(
                optical, imu, alignment, split_ns=split_ns,
                from_ns=max(int(optical.t_ns[ends[i - 1]]), split_ns - round(_WINDOW_S * 1e9)),
                to_ns=min(int(optical.t_ns[ends[i + 1] - 1]), split_ns + round(_WINDOW_S * 1e9)),
            )  # fmt: skip
        verdict = _verdict(step, change)
        is_contradicted |= verdict == "stamps"
        if verdict != "paused":
            level += step.size_ns
            levels_ns.append(level)
        problems.append(_step_words(step, frame, regularity.period_ns, change, verdict))
    spread_ns = max(levels_ns) - min(levels_ns)
    if not regularity.steps and imu is not None and alignment is not None:
        errors = errors_of(optical, imu, alignment)
        change = None if errors is None else change_of_halves(errors)
        if change is not None and change.is_sure:
            is_contradicted, spread_ns = True, abs(change.change_s) * 1e9
            problems.append(
                "the offset of IMU and camera changes by "
                f"{change.change_s * 1e3:+.1f} ± {change.sd_s * 1e3:.1g} ms from the first half of the run "
                "to the second, by the rotations that both saw: the stamps of one of them step or drift. "
                "Poses are as unsure as the motion in that time"
            )
        elif _runs_apart(optical, imu, alignment):
            span_ns = float(optical.t_ns[-1] - optical.t_ns[0])
            is_contradicted, spread_ns = True, 0.5 * abs(alignment.skew) * span_ns
            problems.append(
                f"the clocks of IMU and camera run apart by {alignment.skew * 1e6:.0f} ppm, by the rotations "
                "that both saw, where crystals hold 100: one of the two is scaled. Poses are as unsure as "
                f"the motion in the {spread_ns / 1e6:.1f} ms that come together to either end of the run"
            )
        elif errors is not None and (wander := offset_wander(optical, alignment, errors)) is not None:
            is_contradicted, sd_ns = True, np.hypot(sd_ns, wander.sd_s * 1e9)
            problems.append(
                f"the offset of IMU and camera wanders by {wander.rms_s * 1e3:.1f} ms (rms) within the run, "
                "by the rotations that both saw: the exposure changes and is not the one that is stated, or "
                "frames are stamped late. Fix the exposure, or give each frame's (`bricktrack import "
                "--exposures`). Poses are as unsure as the motion in that time"
            )
    if alignment is not None and alignment.disagrees_with_stamps:
        is_contradicted, spread_ns = True, float(np.hypot(spread_ns, alignment.offset_ns))
        problems.append(
            f"{abs(alignment.offset_ns) / 1e6:.1f} ms between camera and IMU are more than the sensors' lags"
            ": the stamps of one of them are wrong throughout. A picture lost, or there twice, before the "
            f"brick turned would do that, by whole periods of {regularity.period_ns / 1e6:.2f} ms. Poses of "
            "the whole run are as unsure as the motion in that time"
        )
    of_all_ns = np.zeros(n_frames)
    of_all_ns[frame] = np.hypot(sd_ns, spread_ns)
    return StampCheck(regularity, of_all_ns, tuple(problems), is_contradicted)


def _words_on_rate(regularity: StampRegularity, frame: IntArray) -> list[str]:
    """Return what the stamps alone say against themselves, steps left out; ``frame`` are those looked at."""
    problems: list[str] = []
    period_ms = regularity.period_ns / 1e6
    if not regularity.is_steady and len(regularity.stray_ns) >= MIN_FRAMES:
        problems.append(
            f"frame stamps: the intervals vary from {regularity.shortest_ns / 1e6:.2f} to "
            f"{regularity.longest_ns / 1e6:.2f} ms (median {period_ms:.2f} ms), so the stamps cannot be "
            "checked against a steady rate. Fix the camera's frame rate"
        )
    if regularity.jitter_ns > JITTER_NS:
        problems.append(
            f"frame stamps scatter by {regularity.jitter_ns / 1e6:.2g} ms (sd) about a steady period of "
            f"{period_ms:.3f} ms: they were made late or rounded, or the camera is not free-running. Poses "
            "are as unsure as the motion in that time"
        )
    strays = np.flatnonzero(regularity.stray_ns)
    if strays.size:
        worst = int(strays[np.argmax(np.abs(regularity.stray_ns[strays]))])
        problems.append(
            f"{strays.size} frame stamp{'' if strays.size == 1 else 's'} off a steady period of "
            f"{period_ms:.3f} ms, most that of frame {frame[worst]} by "
            f"{regularity.stray_ns[worst] / 1e6:+.2f} ms: poses there are as unsure as the motion in that "
            "time"
        )
    return problems


def _verdict(step: StampStep, change: OffsetChange | None) -> Literal["stamps", "paused", "unknown"]:
    """Return what the motion says of a step: the stamps are wrong, the camera paused, or nothing."""
    if change is None:
        return "unknown"
    if change.is_sure:
        return "stamps"
    # Stamps that step up make the offset step down.
    excluded = abs(change.change_s + step.size_ns * 1e-9) > SIGMA * change.sd_s
    return "paused" if excluded else "unknown"


def _step_words(
    step: StampStep,
    frame: IntArray,
    period_ns: float,
    change: OffsetChange | None,
    verdict: Literal["stamps", "paused", "unknown"],
) -> str:
    found = (
        f"frame stamps step by {step.size_ns / 1e6:+.2f} ms between frames {frame[step.frame - 1]} and "
        f"{frame[step.frame]}: {step.interval_ns / 1e6:.2f} ms is {step.interval_ns / period_ns:.2f} periods "
        f"of a steady {period_ns / 1e6:.3f} ms"
    )
    doubt = "Poses of the whole run are as unsure as the motion in that time"
    if change is None:
        return f"{found}. The motion does not tell whether the camera paused or the stamps are wrong. {doubt}"
    size = f"{change.change_s * 1e3:+.1f} ± {change.sd_s * 1e3:.1g} ms"
    moved = f"offset of IMU and camera changes there by {size}"
    if verdict == "paused":
        return f"{found}. The {moved}: the camera paused, and the stamps are believed"
    if verdict == "stamps":
        return f"{found}, and the {moved}: the stamps are wrong before it or after. {doubt}"
    return f"{found}. The {moved}, too unsure to tell whether the stamps are wrong. {doubt}"


def _runs_apart(optical: OpticalTrack, imu: ImuTrack, alignment: TimeAlignment) -> bool:
    """Return whether the two clocks drift by more than crystals do, and by more than a sample is old.

    A sensor that samples by a clock of its own, and is read by ours, drifts by a sample's interval at most
    before it is found out: less than that is its samples' age, which the rate of the alignment follows.
    """
    span_ns = float(optical.t_ns[-1] - optical.t_ns[0])
    beyond = abs(alignment.skew) > SIGMA * np.hypot(alignment.skew_sd, CLOCK_RATE_SD)
    drift_ns = abs(alignment.skew) * span_ns
    return bool(alignment.source == "data" and beyond and drift_ns > np.median(np.diff(imu.t_ns)))
