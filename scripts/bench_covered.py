"""Poses while something is wrong with LEDs: covered by a card, beside a lamp, at the border, run together, all lost.

Simulated films (domes with a lit collar, sensor noise, rolling shutter, H.264) of a lens that is calibrated from its
own target pictures, solved as `bricktrack process` does before inertial samples come in. A card slides half over each
LED from four sides, stays, and slides on; cards are black, dark, grey or lit white, sharp or out of focus. A lamp's
reflection passes over each LED or grazes it. The brick leaves the picture at each border and comes back. Everything
is hidden for half a second while the brick is put elsewhere. Two LEDs run together as their brick tilts.

``wrong``: frames with an LED that has another light; ``times free``: errors over those of the same frames
undisturbed; ``bound``: the same of the Cramér-Rao bound without the LED, what losing it costs; ``worst``: largest
error over its stated standard deviation, of six axes; ``> 4 sd``: frames with such an error.

    python scripts/bench_covered.py [--seed 2]
"""

import argparse
import re
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from disturbed_films import PERIOD_NS, Disturbance, Luma, draw_card, draw_lamp, make_films, write_motion

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.poses import Pose
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_device.sim.lens import Lens, lens_of
from bricktrack_device.sim.settings import SimSettings
from bricktrack_device.sim.sim_kit import write_sim_kit
from bricktrack_host.calibration.rays.central_rays import CentralRays
from bricktrack_host.calibration.rays.irt import TwoPlaneIrt
from bricktrack_host.evaluation.bound import cramer_rao_covariance
from bricktrack_host.evaluation.filmed import Film
from bricktrack_host.normalised_errors import normalised_squares
from bricktrack_host.results.ray_errors import ray_errors
from bricktrack_host.stages.motion import with_ray_errors
from bricktrack_host.tracking.centroid_noise import with_measured_noise
from bricktrack_host.tracking.frame_errors import frame_errors
from bricktrack_host.tracking.led_tracker import NOT_USED
from bricktrack_host.tracking.odd_leds import with_odd_leds_doubted
from bricktrack_host.tracking.optical_track import solve_poses, start_poses
from bricktrack_host.tracks import LedObservations, OpticalTrack

PERIOD_S = PERIOD_NS * 1e-9
N_LEDS, LED_RADIUS_PX = 7, 37.0
INTRO = 30  # frames before the first event
AWAY = 9.0
# Where the card's edge is in each frame of an event, in LED radii from the LED's middle; 0 leaves half of it.
EDGES = np.array([1.3, 1.0, 0.9, 0.8, 0.6, 0.3, 0.0, 0.0, 0.0, 0.0, -0.3, -0.7, -1.3, AWAY, AWAY])
LIGHTS = {"black": 0.004, "dark": 0.045, "grey": 0.15, "white": 0.4}  # linear; the LEDs have 0.9
SOFT_PX = (2.0, 12.0)
LAMPS = ((12.0, 0.9), (30.0, 0.9), (30.0, 0.4))  # radius, px, and light
LAMP_WAY_PX = 220.0
DROPOUT_S = 0.5
HEADER = (
    "                      frames  poses  wrong       x      y      z mm    deg"
    "    times free: xyz, deg    bound: xyz, deg      NEES/6  worst  > 4 sd"
)


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A film, and what the product makes of it."""

    film: Film
    lens: Lens
    seen: LedObservations
    track: OpticalTrack

    @classmethod
    def of(cls, film: Film, lens: Lens) -> "Solved":
        """Solve a film with all that `process` has of a run's camera."""
        seen = film.observe()
        first = start_poses(seen, film.rays, film.brick)
        errors = frame_errors(seen, first, film.rays, film.brick)
        seen, errors = with_odd_leds_doubted(seen, errors)
        with av.open(str(film.folder / "video.h264")) as container:
            is_keyframe = np.array([packet.is_keyframe for packet in container.demux(video=0) if packet.size])
        seen = with_measured_noise(seen, errors, is_keyframe)
        track = solve_poses(seen, film.rays, film.brick, first=first)
        posed = int(np.flatnonzero(np.isfinite(track.t_camera_brick_mm[:, 0]))[0])
        about = Pose(track.R_camera_brick[posed], track.t_camera_brick_mm[posed])
        assert isinstance(film.rays, CentralRays | TwoPlaneIrt)  # noqa: S101 - a calibration file has no others
        track, _ = with_ray_errors(track, {}, ray_errors(film.rays, film.brick, about))
        return cls(film, lens, seen, track)

    @property
    def error(self) -> FloatArray:
        """[rotation rad, position mm], shape (n, 6), as the covariance has it; NaN without a pose."""
        R, t_mm = self.track.R_camera_brick, self.track.t_camera_brick_mm
        turn = rvec_from_matrix(np.swapaxes(R, -1, -2) @ self.film.R_camera_brick)
        return np.hstack([turn, self.film.t_camera_brick_mm - t_mm])

    @property
    def led_px(self) -> FloatArray:
        """Where the LEDs are in the pictures, shape (n, n_leds, 2)."""
        R, t_mm = self.film.R_camera_brick, self.film.t_camera_brick_mm
        return self.lens.project(
            np.einsum("nij,lj->nli", R, self.film.brick.led_positions_mm) + t_mm[:, None]
        )

    @property
    def is_wrong(self) -> BoolArray:
        """Frames, (n,), in which a pose uses a light farther from an LED than the LED is large."""
        used = (self.seen.led_flags & NOT_USED) == 0
        away = np.linalg.norm(self.seen.uv_px - self.led_px, axis=-1)
        return np.asarray((used & (away > 1.2 * LED_RADIUS_PX)).any(axis=1))

    def row(
        self, name: str, frames: IntArray, *, free: "Solved | None" = None, led: IntArray | None = None
    ) -> str:
        """Return a line of figures of some frames; beside the same undisturbed, and the LED disturbed in each."""
        error = self.error[frames]
        posed = np.isfinite(error).all(axis=1)
        counts = f"{name:21s} {len(frames):6d} {posed.sum():6d} {self.is_wrong[frames].sum():6d}"
        if not posed.any():
            return counts
        error, frames, covariance = error[posed], frames[posed], self.track.covariance[frames[posed]]
        rms = _rms(error)
        ratio = " " * 22 if free is None else _ratios(rms, _rms(free.error[frames]))
        bound = " " * 22 if led is None else _ratios(*self._bounds(frames, led[posed]))
        sigmas = np.abs(error) / np.sqrt(np.einsum("nii->ni", covariance))
        nees = normalised_squares(error, covariance).mean() / 6
        numbers = "  ".join(f"{x:5.3f}" for x in (*rms[3:], np.degrees(np.linalg.norm(rms[:3]))))
        beyond = (sigmas > 4).any(axis=1).sum()
        return f"{counts}   {numbers}    {ratio}   {bound}   {nees:6.2f}  {sigmas.max():5.1f}  {beyond:6d}"

    def _bounds(self, frames: IntArray, led: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the root mean square of the bound without an LED, and with all, shape (6,)."""
        all_seen = np.ones((len(frames), N_LEDS), dtype=np.bool_)
        one_less = all_seen.copy()
        one_less[np.arange(len(frames)), led] = False
        R, t_mm = self.film.R_camera_brick[frames], self.film.t_camera_brick_mm[frames]
        leds_mm = self.film.brick.led_positions_mm
        without, with_all = (
            np.sqrt(np.einsum("nii->ni", bound).mean(axis=0))
            for bound in (
                cramer_rao_covariance(self.lens.project, R, t_mm, leds_mm, seen, noise_px=1.0)
                for seen in (one_less, all_seen)
            )
        )
        return without, with_all


def _rms(error: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(error**2, axis=0)))


def _ratios(a: FloatArray, b: FloatArray) -> str:
    turn = np.linalg.norm(a[:3]) / np.linalg.norm(b[:3])
    return "  ".join(f"{x:4.1f}" for x in (*(a[3:] / b[3:]), turn))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=2)
    seed = parser.parse_args().seed
    print(f"All figures simulated; unit {seed}. Errors of single optical poses, nothing zeroed.\n\n{HEADER}")
    with tempfile.TemporaryDirectory() as scratch:
        cards_and_lamps(Path(scratch) / "cards", seed)
        borders_and_darkness(Path(scratch) / "borders", seed)
        merging(Path(scratch) / "merging", seed)
    return 0


def cards_and_lamps(folder: Path, seed: int) -> None:
    """Print what cards before, and lamps beside, each LED do."""
    rng = np.random.default_rng([seed, 90])
    led = np.repeat(np.arange(N_LEDS), 4)
    angle = np.tile(np.arange(4) * np.pi / 2, N_LEDS) + rng.uniform(-0.4, 0.4, led.size)
    light = np.tile(list(LIGHTS.values()), N_LEDS)[rng.permutation(led.size)]
    soft = rng.choice(SOFT_PX, led.size)
    order = rng.permutation(led.size)
    led, angle = led[order], angle[order]
    n = INTRO + led.size * len(EDGES)
    frames = np.arange(INTRO, n)
    event, part = np.divmod(frames - INTRO, len(EDGES))

    def card(luma: Luma, k: int, uv: FloatArray) -> None:
        j, edge = event[k - INTRO], EDGES[part[k - INTRO]]
        if k >= INTRO and edge < AWAY:
            edge_px = edge * LED_RADIUS_PX
            draw_card(luma, uv[led[j]], angle[j], edge_px, light=light[j], soft_px=soft[j])

    def lamp(luma: Luma, k: int, uv: FloatArray) -> None:
        if k >= INTRO:
            j, share = event[k - INTRO], part[k - INTRO] / (len(EDGES) - 1) - 0.5
            ahead = np.array([np.cos(angle[j]), np.sin(angle[j])])
            aside = (j % 3 - 1) * 25.0 * np.array([-ahead[1], ahead[0]])
            radius_px, lamp_light = LAMPS[j % len(LAMPS)]
            draw_lamp(luma, uv[led[j]] + share * LAMP_WAY_PX * ahead + aside, radius_px, light=lamp_light)

    knots = rng.uniform(-1, 1, (int(n * PERIOD_S) + 3, 6)) * [8, 3, 12, 8, 8, 8]
    knots[:2] = 0
    solved = filmed(folder, seed, np.arange(len(knots), dtype=float), knots, n, {"card": card, "lamp": lamp})
    free, cards, lamps = (solved[k] for k in ("free", "card", "lamp"))
    print(free.row("undisturbed", frames))
    edge, of_led = EDGES[part], led[event]
    covered = edge < AWAY

    def line(name: str, solved: Solved, which: BoolArray) -> None:
        print(solved.row(name, frames[which], free=free, led=of_led[which]), flush=True)

    line("card, half an LED", cards, edge == 0)
    line("  less than half", cards, covered & (edge > 0))
    line("  more than half", cards, covered & (edge < 0))
    for name, value in LIGHTS.items():
        line(f"  {name}", cards, covered & (light[event] == value))
    for k in range(N_LEDS):
        line(f"  before m{k}", cards, covered & (of_led == k))
    line("lamp", lamps, np.ones(frames.size, dtype=np.bool_))
    for i, (radius_px, lamp_light) in enumerate(LAMPS):
        line(f"  {radius_px:g} px, light {lamp_light:g}", lamps, event % len(LAMPS) == i)


def borders_and_darkness(folder: Path, seed: int) -> None:
    """Print what leaving the picture does, and darkness in which the brick is put elsewhere."""
    rng = np.random.default_rng([seed, 91])
    outside = [(57, 0), (-57, 0), (0, 28), (0, -28), (54, 22), (-50, -22), (52, -24), (-52, 24)]
    t_s, knots = [0.0, 0.5], [np.zeros(6), np.zeros(6)]
    for x, y in outside:
        for place in ((x, y), (0, 0)):
            t_s.append(t_s[-1] + 1.0)
            knots.append(np.array([*place, rng.uniform(-8, 8), *rng.uniform(-5, 5, 3)]))
    dark_s = []
    for _ in range(6):
        t_s += [t_s[-1] + 0.7, t_s[-1] + 0.7 + DROPOUT_S]
        dark_s.append(t_s[-2])
        knots += [knots[-1], rng.uniform(-1, 1, 6) * [18, 8, 15, 15, 15, 15]]
    t_s.append(t_s[-1] + 0.7)
    knots.append(knots[-1])
    n = int(t_s[-1] / PERIOD_S) - 8
    dropouts = [(s, DROPOUT_S) for s in dark_s]
    free = filmed(folder, seed, np.array(t_s), np.array(knots), n, {}, dropouts=dropouts)["free"]
    frame_s = (free.track.t_ns - free.track.t_ns[0]) * 1e-9
    from_border = np.minimum(free.led_px, [1919, 1079] - free.led_px).min(axis=-1)
    in_light = frame_s < dark_s[0] - 0.2
    crossing = (np.abs(from_border) < 1.2 * LED_RADIUS_PX).any(axis=1) & in_light
    whole = (from_border > 1.2 * LED_RADIUS_PX).sum(axis=1)
    print(free.row("LEDs at the border", np.flatnonzero(crossing)))
    for n_whole in (6, 5, 4):
        print(free.row(f"  {n_whole} LEDs whole", np.flatnonzero(in_light & crossing & (whole == n_whole))))
    print(free.row("  fewer", np.flatnonzero(in_light & (whole < 4))))
    since_s = np.min([np.where(frame_s > s, frame_s - s, np.inf) for s in dark_s], axis=0)
    print(free.row("all hidden", np.flatnonzero(since_s < DROPOUT_S)))
    again = np.flatnonzero((since_s > DROPOUT_S + 0.1) & (since_s < DROPOUT_S + 0.6))
    print(free.row("found again elsewhere", again))
    posed = np.isfinite(free.track.t_camera_brick_mm[:, 0])
    after = [int(np.argmax(posed[frame_s > s + DROPOUT_S])) for s in dark_s]
    print(f"{'':23s}frames from the darkness to a pose, while a card slides away: {after}", flush=True)


def merging(folder: Path, seed: int) -> None:
    """Print what two LEDs do that run together as their brick tilts."""
    folder.mkdir(parents=True)
    write_sim_kit(folder, SimSettings(seed=seed))
    kit = (folder / "layout.toml").read_text(encoding="utf-8")
    layout = folder / "close.toml"  # m4 stands 7 mm beside m3
    layout.write_text(
        re.sub(r'(name = "m4"\nposition_mm = )\[.*\]', r"\1[0.0, 21.5, 0.0]", kit), encoding="utf-8"
    )
    tilts = np.array([0.0, 0.0, 58.0, 0.0, -58.0, 0.0])
    knots = np.zeros((len(tilts), 6))
    knots[:, 3] = tilts
    t_s = 1.2 * np.arange(float(len(tilts)))
    n = int(t_s[-1] / PERIOD_S)
    free = filmed(folder, seed, t_s, knots, n, {}, layout=str(layout))["free"]
    apart = np.linalg.norm(free.led_px[:, 3] - free.led_px[:, 4], axis=-1)
    print(free.row("two LEDs apart", np.flatnonzero(apart > 2.2 * LED_RADIUS_PX)))
    print(
        free.row("  touching", np.flatnonzero((apart <= 2.2 * LED_RADIUS_PX) & (apart > 1.8 * LED_RADIUS_PX)))
    )
    print(free.row("  one light", np.flatnonzero(apart <= 1.8 * LED_RADIUS_PX)))


def filmed(
    folder: Path,
    seed: int,
    knots_s: FloatArray,
    knots: FloatArray,
    n_frames: int,
    disturbances: dict[str, Disturbance],
    *,
    dropouts: list[tuple[float, float]] | None = None,
    layout: str = "",
) -> dict[str, Solved]:
    """Film a motion undisturbed and disturbed, and solve all films."""
    folder.mkdir(parents=True, exist_ok=True)
    write_motion(folder / "motion.csv", knots_s, knots)
    settings = SimSettings(
        seed=seed,
        motion="csv",
        motion_csv=str(folder / "motion.csv"),
        quiet_s=0.0,
        dropouts=dropouts or [],
        layout=layout,
    )
    ways = {"free": lambda luma, k, uv: None, **disturbances}
    films = make_films(folder, settings, n_frames, ways)
    return {name: Solved.of(film, lens_of(seed)) for name, film in films.items()}


if __name__ == "__main__":
    sys.exit(main())
