import io
import threading

import av
import numpy as np
import pytest
from device_fakes import FakeCamera, FakeRig

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.checksums import crc32
from bricktrack_common.run_manifest import CameraSection
from bricktrack_device import still as still_module
from bricktrack_device.backends import open_rig
from bricktrack_device.capture import camera_stream
from bricktrack_device.config import DeviceConfig, LedsTable
from bricktrack_device.interfaces import Still
from bricktrack_device.refusals import RequestRefusedError
from bricktrack_device.still import TakenStill, encode_still, take_still

SECTION = CameraSection(
    model="fake", mode=IMX219_1080P, exposure_us=2000, analogue_gain=1.5, colour_gains=(1.0, 2.0),
    frame_duration_us=33_327, encoder="none", encoder_settings={},
)  # fmt: skip


def picture(luma: int = 16, *, noise: bool = False) -> Still:
    y = np.full((48, 64), luma, np.uint8)
    if noise:
        y = np.random.default_rng(5).integers(16, 236, y.shape, dtype=np.uint8)
    return Still(y, np.full((24, 32), 128, np.uint8), np.full((24, 32), 128, np.uint8))


def decoded(data: bytes, form: str) -> np.ndarray:
    with av.open(io.BytesIO(data)) as container:
        return next(container.decode(video=0)).to_ndarray(format=form)


def encoded(still: Still, encoding: str) -> tuple[object, bytes]:
    return encode_still(TakenStill(still, SECTION, None, 7), encoding, simulated=True)  # type: ignore[arg-type]


def test_a_png_is_the_luma_plane_without_loss() -> None:
    still = picture(noise=True)
    image, data = encoded(still, "png")
    assert data.startswith(b"\x89PNG\r\n")
    assert np.array_equal(decoded(data, "gray"), still.luma)
    assert (image.width_px, image.height_px, image.n_bytes, image.crc32) == (64, 48, len(data), crc32(data))
    assert (image.model, image.exposure_us, image.colour_gains, image.taken_ns) == (
        "fake",
        2000,
        (1.0, 2.0),
        7,
    )


@pytest.mark.parametrize(("luma", "expected"), [(16, 0), (235, 255), (126, 128)])
def test_a_jpeg_has_full_range(luma: int, expected: int) -> None:
    # (126 - 16) / 219 * 255 = 128.1; a level for JPEG's own rounding.
    rgb = decoded(encoded(picture(luma), "jpeg")[1], "rgb24")
    assert np.all(np.abs(rgb.astype(int) - expected) <= 2)


def test_a_jpeg_keeps_colour() -> None:
    still = picture(81)
    still.chroma_u[:], still.chroma_v[:] = 90, 240  # BT.601's pure red
    rgb = decoded(encoded(still, "jpeg")[1], "rgb24").reshape(-1, 3).mean(axis=0)
    assert rgb[0] > 240 and rgb[1] < 15 and rgb[2] < 15


def test_the_camera_is_stopped_and_the_leds_are_lit_only_for_the_picture() -> None:
    rig = FakeRig()
    rig.camera.picture = picture()
    beats = []
    taken = take_still(DeviceConfig(), rig, lit=True, beat=lambda: beats.append(1))
    assert taken.still is rig.camera.picture and taken.lit is None and beats
    assert rig.camera.n_stops == 1
    with_leds = DeviceConfig(leds=LedsTable(pins=["GPIO22"]))
    for lit in (True, False):
        assert take_still(with_leds, rig, lit=lit, beat=lambda: None).lit is lit
        assert not rig.factory.pin("GPIO22").state


def test_a_camera_without_pictures_and_one_that_does_not_start_are_refused_with_words(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(still_module, "STILL_TIMEOUT_S", 0.2)
    rig = FakeRig()
    with pytest.raises(RequestRefusedError, match="gave none within") as e:
        take_still(DeviceConfig(), rig, lit=True, beat=lambda: None)
    assert e.value.code == "not-ready" and rig.camera.n_stops == 1
    broken = FakeRig(camera=FakeCamera(fail="no ribbon"))
    with pytest.raises(RequestRefusedError, match="no picture: no ribbon"):
        take_still(DeviceConfig(), broken, lit=True, beat=lambda: None)


def test_the_simulated_camera_gives_a_picture_with_its_leds() -> None:
    config = DeviceConfig(backend="sim", leds=LedsTable(pins=["GPIO22"]))
    bright = {}
    for lit in (True, False):
        rig = open_rig(config)
        try:
            taken = take_still(config, rig, lit=lit, beat=lambda: None)
        finally:
            rig.close()
        image, data = encode_still(taken, "png", simulated=True)
        assert (image.width_px, image.height_px, image.lit) == (1920, 1080, lit)
        assert image.mode == taken.section.mode.name and image.exposure_us == taken.section.exposure_us
        bright[lit] = int((decoded(data, "gray") > 200).sum())
    # Seven LEDs of 60 to 75 px across, by the pinhole formula; the rings in the view shine in both pictures.
    assert 7 * 2800 < bright[True] - bright[False] < 7 * 4500


def test_a_bug_in_stopping_the_camera_asks_for_a_new_start_too() -> None:
    rig = FakeRig()
    rig.camera.stop_error = RuntimeError("a bug")
    lost: list[str] = []
    with pytest.raises(RuntimeError, match="a bug"):
        take_still(DeviceConfig(), rig, lit=True, beat=lambda: None, note_lost_camera=lost.append)
    assert lost == ["a bug"]


def test_giving_up_while_the_camera_starts_stops_it() -> None:
    class GiveUpError(Exception):
        pass

    def beat() -> None:
        raise GiveUpError

    rig = FakeRig()
    with pytest.raises(GiveUpError):
        take_still(DeviceConfig(), rig, lit=True, beat=beat)
    assert rig.camera.n_stops == 1


def test_a_camera_that_hangs_is_left_behind_and_asks_for_a_new_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_stream, "START_TIMEOUT_S", 0.05)
    rig = FakeRig()
    never = threading.Event()
    monkeypatch.setattr(rig.camera, "start", lambda sink: never.wait(5))
    lost: list[str] = []
    with pytest.raises(RequestRefusedError, match="start hangs"):
        take_still(DeviceConfig(), rig, lit=True, beat=lambda: None, note_lost_camera=lost.append)
    assert len(lost) == 1 and "start hangs" in lost[0]
    never.set()
