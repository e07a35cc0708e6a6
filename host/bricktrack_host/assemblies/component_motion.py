"""Each component of an assembly seen from its base, at every sample of the laboratory's clock."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import IntArray
from bricktrack_common.errors import BricktrackError
from bricktrack_host.assemblies.motion import Motion, disagreement
from bricktrack_host.quality import PoseFlag
from bricktrack_host.results.rest_pose import FromRest
from bricktrack_host.results.result_store import RunResult
from bricktrack_host.tracks import FusedTrack, OpticalTrack
from bricktrack_host.transfer.assembly_config import AssemblyConfig, View


class AssemblyError(BricktrackError, ValueError):
    """The results at hand do not make an assembly's motion."""


@dataclass(frozen=True, slots=True, eq=False)
class ComponentMotion:
    """One component seen from the base.

    Attributes
    ----------
    component : str
    chain : tuple of str
        Units whose views lead from the base to the component, in order.
    motion : Motion
        One row for each sample of `AssemblyMotion.sample`.
    """

    component: str
    chain: tuple[str, ...]
    motion: Motion


@dataclass(frozen=True, slots=True, eq=False)
class LoopCheck:
    """A view that closes a loop: what it saw against what the chains say.

    Attributes
    ----------
    unit : str
    rms_mm, max_mm, rms_deg, max_deg : float
        Length of the disagreement, of the point at the brick's origin and of the rotation.
    normalised : float
        Mean squared disagreement over its covariance and degrees of freedom; about 1 if all is honest.
    """

    unit: str
    rms_mm: float
    max_mm: float
    rms_deg: float
    max_deg: float
    normalised: float


@dataclass(frozen=True, slots=True, eq=False)
class AssemblyMotion:
    """All components of an assembly at the samples that any of its units saw.

    Attributes
    ----------
    name, base : str
    sample : ndarray of int64, shape (n,)
        The laboratory's sample numbers, without a gap.
    components : tuple of ComponentMotion
        All but the base, in the order of the configuration; those that no result reaches are left out.
    loops : tuple of LoopCheck
    problems : tuple of str
        In words.
    """

    name: str
    base: str
    sample: IntArray
    components: tuple[ComponentMotion, ...]
    loops: tuple[LoopCheck, ...]
    problems: tuple[str, ...]


def assembly_motion(
    assembly: AssemblyConfig, results: Mapping[str, RunResult], *, slips: Mapping[str, int] | None = None
) -> AssemblyMotion:
    """Return how the components of an assembly moved against its base, from rest, in brick axes.

    A unit's LEDs tell how the component they are on moved, seen from the component that its camera is on; the
    product of such views along the shortest chain leads from the base to each component. Displacements count
    from rest (tare), so where a camera sits on its component does not matter, and where LEDs sit matters for
    rotations only, as ``X D X^-1`` with X the layout's place in the brick.

    Parameters
    ----------
    assembly : AssemblyConfig
        Checked.
    results : mapping of unit to RunResult
        Of one test. Units that are missing, or could not be fused, are named among the problems.
    slips : mapping of unit to int, optional
        Samples to add to a unit's edge numbers, as `compare_edges` found them.

    Raises
    ------
    AssemblyError
        If no view of the assembly has a result.
    """
    problems: list[str] = []
    tracks: dict[str, tuple[IntArray, Motion]] = {}
    for view in assembly.view:
        usable = _usable(view.unit, results.get(view.unit), problems)
        if usable is not None:
            index, motion = usable
            tracks[view.unit] = index + (slips or {}).get(view.unit, 0), motion
    if not tracks:
        raise AssemblyError(
            f"assembly {assembly.name!r}: none of its units has a usable result: {problems[0]}"
        )
    first = min(int(index[0]) for index, _ in tracks.values())
    last = max(int(index[-1]) for index, _ in tracks.values())
    sample = np.arange(first, last + 1)
    seen = {
        view.unit: _motion_of(view, sample, *tracks[view.unit])
        for view in assembly.view
        if view.unit in tracks
    }
    motions, chains = _from_base(assembly, seen, len(sample))
    used = {unit for chain in chains.values() for unit in chain}
    names = [component.name for component in assembly.component]
    lost = [name for name in names if name not in motions]
    if lost:
        problems.append(
            f"{', '.join(lost)}: not seen from the base {assembly.base}, for want of the results above"
        )
    loops = [
        _loop_check(view, seen[view.unit], motions)
        for view in assembly.view
        if view.unit in seen and view.unit not in used and view.camera_on in motions
    ]
    problems += [
        f"{loop.unit}: the loop that it closes gapes by {loop.rms_mm:.3f} mm and {loop.rms_deg:.3f} deg rms, "
        f"{loop.normalised:.1f} times the variance expected: a mount in the fleet file, a layout "
        "or a slip is wrong"
        for loop in loops
        if loop.normalised > 4.0
    ]
    return AssemblyMotion(
        name=assembly.name,
        base=assembly.base,
        sample=sample,
        components=tuple(
            ComponentMotion(name, chains[name], motions[name])
            for name in names
            if name in motions and name != assembly.base
        ),
        loops=tuple(loops),
        problems=tuple(problems),
    )


def _from_base(
    assembly: AssemblyConfig, seen: Mapping[str, Motion], n: int
) -> tuple[dict[str, Motion], dict[str, tuple[str, ...]]]:
    """Return how each component that views lead to moved against the base, and the units of its chain."""
    at_rest = Motion(
        np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.zeros((n, 6, 6)), np.zeros(n, np.int64)
    )
    motions: dict[str, Motion] = {assembly.base: at_rest}
    chains: dict[str, tuple[str, ...]] = {assembly.base: ()}
    while True:
        reached = dict(motions)  # one more view a round: chains stay the shortest
        for view in assembly.view:
            if view.unit not in seen:
                continue
            for start, end, step in _both_ways(view, seen[view.unit]):
                if start in reached and end not in motions:
                    motions[end] = reached[start] @ step
                    chains[end] = (*chains[start], view.unit)
        if len(motions) == len(reached):
            return motions, chains


def _usable(unit: str, result: RunResult | None, problems: list[str]) -> tuple[IntArray, Motion] | None:
    if result is None:
        problems.append(f"{unit}: no result in this test")
        return None
    if "edge" not in result.fused or not len(result.edge_index):
        problems.append(f"{unit}: no motion at the edges of the square wave")
        return None
    if result.rest is None:
        problems.append(f"{unit}: no rest pose, so no displacement from rest")
        return None
    return result.edge_index, motion_from_rest(result.from_rest["edge"], result.fused["edge"])


def motion_from_rest(seen: FromRest, track: FusedTrack | OpticalTrack) -> Motion:
    """Return how the LEDs' component moved from rest, in the layout's axes at rest.

    The covariance holds that of the rest pose too. ``seen``: the poses of the track.
    """
    return Motion(seen.R, seen.t_mm, seen.covariance, track.flags)


def _motion_of(view: View, sample: IntArray, index: IntArray, seen: Motion) -> Motion:
    """Return what one view saw, in brick axes; NaN at samples that it did not see."""
    n = len(sample)
    R, t_mm = np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan)
    covariance = np.full((n, 6, 6), np.nan)
    flags = np.full(n, int(PoseFlag.NO_POSE), dtype=np.int64)
    rows = index - sample[0]
    R[rows], t_mm[rows], covariance[rows], flags[rows] = seen.R, seen.t_mm, seen.covariance, seen.flags
    return Motion(R, t_mm, covariance, flags).in_axes(view.pose_brick_layout)


def _both_ways(view: View, motion: Motion) -> tuple[tuple[str, str, Motion], tuple[str, str, Motion]]:
    """Return a view as a step from camera to LEDs, and as one from LEDs to camera."""
    return (view.camera_on, view.leds_on, motion), (view.leds_on, view.camera_on, motion.inverse())


def _loop_check(view: View, seen: Motion, motions: Mapping[str, Motion]) -> LoopCheck:
    expected = motions[view.camera_on].inverse() @ motions[view.leds_on]
    position_mm, rotation_rad, normalised = disagreement(seen, expected)
    length_mm = np.linalg.norm(position_mm, axis=1)
    angle_deg = np.rad2deg(np.linalg.norm(rotation_rad, axis=1))
    known = np.isfinite(normalised)
    if not known.any():
        return LoopCheck(view.unit, *(float("nan"),) * 5)
    return LoopCheck(
        unit=view.unit,
        rms_mm=float(np.sqrt(np.mean(length_mm[known] ** 2))),
        max_mm=float(length_mm[known].max()),
        rms_deg=float(np.sqrt(np.mean(angle_deg[known] ** 2))),
        max_deg=float(angle_deg[known].max()),
        normalised=float(np.mean(normalised[known]) / 6),
    )
