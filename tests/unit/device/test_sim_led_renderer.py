"""The rendered LEDs against OpenCV's projection of the lit body's surface: none of it is the renderer's own code."""

import cv2
import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.camera_model import IMX219_1080P, SensorMode
from bricktrack_device.sim.led_renderer import LedRenderer
from bricktrack_device.sim.lens import Lens, lens_of
from bricktrack_device.sim.settings import HiddenLed, SimSettings
from bricktrack_device.sim.world import SimWorld, make_epoch

LENS = lens_of(1)
EXPOSURE_NS = 4_000_000
STAMP_NS = 50_000_000_000
LINE_NS = 18_903.5
DARK_ROOM = SimSettings(clutter=0.0, noise=0.0)


def opencv_pixels(lens: Lens, points_camera_mm: FloatArray) -> FloatArray:
    K = np.array([[lens.focal_px, 0, lens.cx_px], [0, lens.focal_px, lens.cy_px], [0, 0, 1.0]])
    distortion = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
    uv, _ = cv2.projectPoints(points_camera_mm, np.zeros(3), np.zeros(3), K, distortion)
    return np.asarray(uv[:, 0], dtype=np.float64)


def outline_centroid(uv: FloatArray) -> FloatArray:
    """Return the centre of area of the convex hull of points."""
    hull = cv2.convexHull(uv.astype(np.float32))[:, 0].astype(np.float64)
    a, b = hull, np.roll(hull, -1, axis=0)
    cross = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
    return np.asarray(((a + b) * cross[:, None]).sum(axis=0) / (3 * cross.sum()))


def lit_body(radius_mm: float, collar_mm: float, axis: FloatArray) -> FloatArray:
    """Return many points on a hemisphere about the origin and on the rim at the foot of its collar."""
    side = np.cross(axis, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(axis, side), axis])
    height, angle = np.meshgrid(np.linspace(0, 0.999, 40), np.linspace(0, 2 * np.pi, 180))
    ring = np.sqrt(1 - height**2)
    dome = radius_mm * np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=-1).reshape(-1, 3)
    rim = np.stack([np.cos(angle[:, 0]), np.sin(angle[:, 0]), np.zeros(180)], axis=-1) * radius_mm
    return np.concatenate([dome, rim - [0, 0, collar_mm]]) @ frame


def light(luma: NDArray[np.uint8]) -> FloatArray:
    """Return linear light, by the inverse of the Rec. 709 curve as the recommendation prints it."""
    v = np.clip((luma.astype(np.float64) - 16) / 219, 0, 1)
    return np.where(v < 0.081, v / 4.5, ((v + 0.099) / 1.099) ** (1 / 0.45))


class MovingWorld(SimWorld):
    """The brick at a constant velocity, mm/s, through its rest pose at `STAMP_NS`."""

    def __init__(self, settings: SimSettings, velocity_mmps: FloatArray) -> None:
        super().__init__(settings, make_epoch())
        self._velocity = velocity_mmps

    def pose(self, t_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        R, t_mm = self.rest_pose
        since_s = (np.asarray(t_ns) - STAMP_NS)[:, None] * 1e-9
        return np.repeat(R[None], len(since_s), axis=0), t_mm + since_s * self._velocity


def render(world: SimWorld, mode: SensorMode = IMX219_1080P) -> NDArray[np.uint8]:
    renderer = LedRenderer(world.settings, world, lens=LENS, mode=mode, exposure_ns=EXPOSURE_NS)
    return renderer.luma(STAMP_NS)


def blob_centroid(picture: FloatArray, near_uv: FloatArray, reach: int = 62) -> FloatArray:
    """Return the centre of area of a blob, the soft edge weighed by its light; dimmer limbs count whole."""
    u0, v0 = np.rint(near_uv).astype(int) - reach
    window = np.clip(picture[v0 : v0 + 2 * reach, u0 : u0 + 2 * reach] / 0.45, 0, 1)
    v, u = np.mgrid[v0 : v0 + 2 * reach, u0 : u0 + 2 * reach]
    return np.array([(u * window).sum(), (v * window).sum()]) / window.sum()


def expected_centroid(world: SimWorld, i_led: int, velocity_mmps: FloatArray) -> FloatArray:
    """Return the outline's centroid at the middle of the exposure of the row that it lies in."""
    R, t_mm = world.rest_pose
    body = lit_body(3.0, world.settings.collar_mm, R @ world.brick.led_axes[i_led])
    centre = R @ world.brick.led_positions_mm[i_led] + t_mm
    uv = np.zeros(2)
    for _ in range(6):
        since_s = (uv[1] * LINE_NS - EXPOSURE_NS / 2) * 1e-9
        uv = outline_centroid(opencv_pixels(LENS, body + centre + since_s * velocity_mmps))
    return uv


@pytest.mark.parametrize("collar_mm", [0.0, 0.7, 2.0])
def test_blobs_at_rest_lie_on_the_outlines_that_opencv_projects(collar_mm: float) -> None:
    world = MovingWorld(SimSettings(clutter=0.0, noise=0.0, collar_mm=collar_mm), np.zeros(3))
    picture = light(render(world))
    for i in range(world.brick.n_leds):
        expected = expected_centroid(world, i, np.zeros(3))
        # The hull's 180 corners and eight bits of luma; a bare hemisphere differs from a 0.7 mm collar by 5 px.
        np.testing.assert_allclose(blob_centroid(picture, expected), expected, atol=0.03)


@pytest.mark.parametrize("velocity", [(250.0, 0.0, 0.0), (0.0, -250.0, 0.0), (180.0, -170.0, 60.0)])
def test_each_row_shows_the_brick_at_the_middle_of_its_own_exposure(
    velocity: tuple[float, float, float],
) -> None:
    world = MovingWorld(DARK_ROOM, np.array(velocity))
    picture = light(render(world))
    for i in range(world.brick.n_leds):
        expected = expected_centroid(world, i, np.array(velocity))
        # 0.1 px is 30 us at 250 mm/s (second-order smear over the LED's own rows); the frame's ends differ by 20 px.
        np.testing.assert_allclose(blob_centroid(picture, expected, 75), expected, atol=0.1)


def test_rows_read_upwards_are_timed_upwards() -> None:
    velocity = np.array([200.0, 0.0, 0.0])
    up = msgspec.structs.replace(IMX219_1080P, row_order="up")
    pictures = [light(render(MovingWorld(DARK_ROOM, velocity), mode)) for mode in (IMX219_1080P, up)]
    world = MovingWorld(DARK_ROOM, velocity)
    R, t_mm = world.rest_pose
    for i in (0, 6):  # m0 is high in the picture, m6 low
        expected = expected_centroid(world, i, velocity)
        z_mm = float((R @ world.brick.led_positions_mm[i] + t_mm)[2])
        down_uv, up_uv = (blob_centroid(p, expected, 90) for p in pictures)
        moved_px = (1079 - 2 * expected[1]) * LINE_NS * 1e-9 * 200 * LENS.focal_px / z_mm
        # Distortion makes the scale differ from the focal length's by a few per cent off the centre.
        assert up_uv[0] - down_uv[0] == pytest.approx(moved_px, rel=0.08)


def test_blur_is_as_long_as_the_way_during_the_exposure() -> None:
    still, fast = (light(render(MovingWorld(DARK_ROOM, np.array([v, 0, 0])))) for v in (0.0, 250.0))
    world = MovingWorld(DARK_ROOM, np.array([250.0, 0, 0]))
    widths = []
    for picture, velocity in ((still, 0.0), (fast, 250.0)):
        u, v = np.rint(expected_centroid(world, 1, np.array([velocity, 0, 0]))).astype(int)
        row = picture[v, u - 70 : u + 70]
        widths.append((row > 0.02).sum() - (row > 0.5).sum())
    # m1's dome is at z = 141 mm: 250 mm/s over 4 ms is 1 mm, 11.7 px; the edges' light from 2 to 50 %.
    assert widths[1] - widths[0] == pytest.approx(11.7, abs=3)


def test_a_brighter_led_saturates_and_a_noisier_sensor_is_noisier() -> None:
    bright = render(MovingWorld(SimSettings(clutter=0.0, noise=0.0, led_level=3.0), np.zeros(3)))
    assert bright.max() == 235 and (bright == 235).sum() > 7 * 2500
    grainy = render(MovingWorld(SimSettings(clutter=0.0, noise=4.0), np.zeros(3)))
    quiet = render(MovingWorld(SimSettings(clutter=0.0, noise=1.0), np.zeros(3)))
    corner = (slice(0, 100), slice(0, 100))
    assert grainy[corner].std() > 2 * quiet[corner].std() > 0


class TestOcclusion:
    FIRST_NS = 40_000_000_000

    def renderer(self, settings: SimSettings) -> LedRenderer:
        world = SimWorld(msgspec.structs.replace(settings, quiet_s=100.0), make_epoch())
        world.schedule(self.FIRST_NS - round(settings.shake_delay_s * 1e9))
        return LedRenderer(settings, world, lens=LENS, mode=IMX219_1080P, exposure_ns=EXPOSURE_NS)

    def picture(self, renderer: LedRenderer, since_s: float) -> FloatArray:
        return light(renderer.luma(self.FIRST_NS + round(since_s * 1e9)))

    def blobs(self, renderer: LedRenderer, since_s: float) -> int:
        n, _ = cv2.connectedComponents((self.picture(renderer, since_s) > 0.3).astype(np.uint8))
        return int(n) - 1

    def test_a_hidden_led_is_dark_and_the_others_are_not(self) -> None:
        hidden = [HiddenLed(name="m3", start_s=2.0, duration_s=1.0)]
        renderer = self.renderer(SimSettings(clutter=0.0, hidden_leds=hidden))
        assert [self.blobs(renderer, t) for t in (1.9, 2.1, 2.9, 3.1)] == [7, 6, 6, 7]

    def test_a_dropout_hides_all_leds_from_its_start_to_its_end(self) -> None:
        renderer = self.renderer(SimSettings(clutter=0.0, dropouts=[(2.0, 1.0)]))
        # A frame spans 4 ms before its stamp to 20 ms after it; the card slides for 60 ms before and after.
        assert [self.blobs(renderer, t) for t in (1.9, 2.005, 2.97, 3.065)] == [7, 0, 0, 7]

    def test_the_card_cuts_leds_while_it_slides(self) -> None:
        renderer = self.renderer(SimSettings(clutter=0.0, noise=0.0, dropouts=[(2.0, 1.0)]))
        areas = [(self.picture(renderer, t) > 0.3).sum() for t in np.arange(1.93, 2.01, 0.01)]
        assert areas == sorted(areas, reverse=True) and len(set(areas)) > 4 and areas[-1] == 0
