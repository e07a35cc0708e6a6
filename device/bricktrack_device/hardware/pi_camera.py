"""A Raspberry Pi camera by picamera2: fixed controls, checked; H.264 and metadata into a frame sink."""

import errno
import logging
import threading
from collections.abc import Callable
from typing import Any

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import HardwareError
from bricktrack_common.run_manifest import CameraSection
from bricktrack_device.hardware.camera_checks import (
    ControlsCheck,
    FrameReport,
    check_configuration,
    check_frame_rate,
    sensor_mode,
)
from bricktrack_device.hardware.camera_settings import PiCameraSettings
from bricktrack_device.hardware.h264 import EncoderSettings, make_encoder
from bricktrack_device.hardware.packet_tap import MetadataTap, PacketTap, output_of
from bricktrack_device.hardware.sensor_subdev import read_line_timing
from bricktrack_device.hardware.versions import require
from bricktrack_device.hardware.yuv import split_i420
from bricktrack_device.in_time import finishes
from bricktrack_device.interfaces import FrameSink, Still

logger = logging.getLogger(__name__)

PICAMERA2_MINIMUM = "0.3.32"
_INSTALL = "sudo apt install python3-picamera2, and a virtual environment with --system-site-packages"
_SETTLE_S = 10.0
_FIRST_PACKET_S = 10.0
_STOP_S = 4.5
"""For all the steps of stopping together; the daemon gives up after 5 s."""
_STILL_S = 2.0
_SILENT_NS = 1_000_000_000

LineTimeReader = Callable[[str, str], float]
"""Sensor model and libcamera's camera id to the line time of the running mode, ns."""


def _line_time_ns(model: str, camera_id: str) -> float:
    return read_line_timing(model, camera_id).line_time_ns


class PiCamera:
    """A camera that streams from `start` to `stop`.

    Parameters
    ----------
    settings : PiCameraSettings
    line_time : callable
        Where the line time comes from: the sensor's kernel driver.
    """

    def __init__(self, settings: PiCameraSettings, *, line_time: LineTimeReader = _line_time_ns) -> None:
        self._settings = settings
        self._line_time = line_time
        self._picam2: Any = None
        self._encoder: Any = None
        self._packets: PacketTap | None = None
        self._metadata: MetadataTap | None = None
        self._is_lost = False

    def start(self, sink: FrameSink) -> CameraSection:
        """Open, configure and start the camera, check what it does, then stream into ``sink``.

        Raises
        ------
        HardwareError
            If there is no camera, it is in use, memory is short, or it does not do what it was told.
        """
        if self._is_lost:
            raise HardwareError(
                "camera: the last stop did not come to an end; restart bricktrackd to have the camera back"
            )
        if self._picam2 is not None:
            raise HardwareError("camera: it streams already; stop it before starting it again")
        try:
            return self._start(sink)
        except BaseException as e:
            try:
                self.stop()
            except HardwareError as later:
                logger.warning("%s", later)
            if isinstance(e, HardwareError) or not isinstance(e, (RuntimeError, OSError, LookupError)):
                raise
            raise HardwareError(f"camera: {e}{_advice(e)}") from e

    def _start(self, sink: FrameSink) -> CameraSection:
        settings = self._settings
        libcamera, picamera2, encoders = _import_picamera2()
        camera_id, model = _choose(picamera2.Picamera2.global_camera_info(), settings.camera_num)
        # The encoder first: making it imports PyAV, which takes seconds on a small Pi.
        self._encoder, encoder_name, encoder_settings = make_encoder(settings, encoders)
        self._picam2 = picamera2.Picamera2(settings.camera_num)
        controls = settings.controls(libcamera.controls.draft.NoiseReductionModeEnum.Off)

        check: ControlsCheck | None = None
        settled = threading.Event()

        def hear(report: FrameReport) -> None:
            if check is not None and not check.steady:
                check.add(report)
                if check.steady:
                    settled.set()

        self._metadata = MetadataTap(sink, monotonic_ns)
        self._metadata.on_report = hear
        self._picam2.pre_callback = self._metadata
        n_buffers = self._start_streaming(controls)

        line_time_ns = self._line_time(model, camera_id)
        check = ControlsCheck(settings, line_time_ns / 1000)
        deadline_ns = monotonic_ns() + round(_SETTLE_S * 1e9)
        while not settled.wait(0.05):
            if self._metadata.last_error is not None or monotonic_ns() > deadline_ns:
                break
        self._metadata.on_report = None
        if self._metadata.last_error is not None:
            raise self._metadata.last_error
        check.require_steady()
        reports = check.reports
        check_frame_rate(reports, tolerance=settings.rate_tolerance)
        mode_crop = self._mode_crop()
        mode = sensor_mode(
            model=model,
            settings=settings,
            mode_crop=mode_crop,
            scaler_crop=reports[-1].scaler_crop or mode_crop,
            line_time_ns=line_time_ns,
        )
        self._start_encoder(sink)
        last = reports[-1]
        extra: EncoderSettings = {"buffers": n_buffers}
        return CameraSection(
            model=model,
            mode=mode,
            exposure_us=last.exposure_us,
            analogue_gain=last.analogue_gain,
            colour_gains=last.colour_gains or settings.colour_gains,
            frame_duration_us=last.frame_duration_us,
            encoder=encoder_name,
            encoder_settings=encoder_settings | extra,
        )

    def _start_streaming(self, controls: dict[str, object]) -> int:
        """Configure and start, with fewer buffers as long as memory is short; return how many there are."""
        mode = self._settings.mode
        for n_buffers in self._settings.buffer_counts:
            try:
                config = self._picam2.create_video_configuration(
                    main={"size": mode.picture_size, "format": self._settings.picture_format},
                    sensor={"output_size": mode.sensor_size, "bit_depth": mode.bit_depth},
                    controls=controls,
                    buffer_count=n_buffers,
                    display=None,
                    encode="main",
                )
                self._picam2.configure(config)
                check_configuration(self._picam2.camera_configuration(), self._settings)
                self._picam2.start()
            except (OSError, RuntimeError) as e:
                if isinstance(e, HardwareError) or not _is_out_of_memory(e):
                    raise
                logger.warning("camera: no memory for %d buffers (%s)", n_buffers, e)
                continue
            return n_buffers
        raise HardwareError(
            f"camera: no memory for {self._settings.buffer_counts[-1]} picture buffers. Free CMA memory: "
            "'grep Cma /proc/meminfo' shows it; use the Lite system, without a desktop, or a larger "
            "'dtoverlay=vc4-kms-v3d,cma-...' in config.txt"
        )

    def _mode_crop(self) -> tuple[int, int, int, int]:
        """Return the part of the sensor that the running mode reads: x, y, width, height, sensor px."""
        try:
            _, largest, _ = self._picam2.camera_controls["ScalerCrop"]
        except KeyError as e:
            raise HardwareError(
                "camera: it does not tell which part of the sensor it reads (ScalerCrop); expected a "
                "Raspberry Pi camera"
            ) from e
        x, y, width, height = (int(n) for n in largest)
        return x, y, width, height

    def _start_encoder(self, sink: FrameSink) -> None:
        """Start encoding, and wait for the first packet."""
        first = threading.Event()
        self._packets = _NotifyingTap(self._encoder, sink, first)
        self._picam2.start_encoder(self._encoder, output_of(self._packets), name="main")
        if not first.wait(_FIRST_PACKET_S):
            raise HardwareError(
                f"camera: the encoder gave no picture within {_FIRST_PACKET_S:g} s"
                f"{_because(self._packets.last_error)}. Check that no other program uses the encoder, and "
                "'dmesg' for its driver"
            )

    def still(self) -> Still | None:
        """Return a picture of now; `None` where the camera does not stream or does not answer in time."""
        picam2 = self._picam2
        if picam2 is None or not self._event_loop_alive():
            return None
        taken: list[Any] = []
        try:
            in_time = finishes(
                lambda: taken.append(picam2.capture_array("main")), within_s=_STILL_S, name="camera: still"
            )
        except (RuntimeError, OSError, ValueError) as e:
            logger.warning("camera: no still: %s", e)
            return None
        return split_i420(taken[0], self._settings.mode.picture_size) if in_time else None

    def problem(self) -> str | None:
        """Return what is wrong with a camera that should stream, or `None`.

        Looks only at counters and threads: cheap enough for a watchdog's loop.
        """
        if self._picam2 is None or self._metadata is None:
            return "camera: it does not stream"
        if not self._event_loop_alive():
            return "camera: its thread has died; see the log for picamera2's traceback, then re-arm"
        for tap in (self._metadata, self._packets):
            if tap is not None and tap.last_error is not None:
                return f"camera: {tap.n_failed} frames were lost on the way: {tap.last_error}"
        newest_ns = self._metadata.newest_ns
        if newest_ns is not None and monotonic_ns() - newest_ns > _SILENT_NS:
            silent_s = (monotonic_ns() - newest_ns) / 1e9
            return f"camera: no frame for {silent_s:.1f} s; check the ribbon cable"
        return None

    def stop(self) -> None:
        """Stop and close. Never hangs: what does not end in time is left behind.

        Raises
        ------
        HardwareError
            If the camera did not stop in time. It cannot be started again by this process.
        """
        picam2, encoder = self._picam2, self._encoder
        self._picam2 = self._encoder = None
        if picam2 is None:
            return
        if not _thread_alive(picam2):
            # A request to a dead event loop waits for ever; without one, picamera2 stops in our own thread.
            picam2.detach_preview()
        steps: list[tuple[str, Callable[[], object]]] = [("stop", picam2.stop)]
        if encoder is not None and encoder.running:
            steps.append(("stop the encoder", lambda: picam2.stop_encoder(encoder)))
        steps.append(("close", picam2.close))
        deadline_ns = monotonic_ns() + round(_STOP_S * 1e9)
        for what, step in steps:
            left_s = max(0.1, (deadline_ns - monotonic_ns()) / 1e9)
            try:
                done = finishes(step, within_s=left_s, name=f"camera: {what}")
            except Exception as e:  # noqa: BLE001  the next step must be tried whatever this one says
                logger.warning("camera: could not %s: %s", what, e)
                continue
            if not done:
                self._is_lost = True
                raise HardwareError(
                    f"camera: it did not {what} within {left_s:.1f} s; restart bricktrackd to have it back"
                )

    def _event_loop_alive(self) -> bool:
        return self._picam2 is not None and _thread_alive(self._picam2)


class _NotifyingTap(PacketTap):
    """A packet tap that says when the first packet has come."""

    def __init__(self, encoder: Any, sink: FrameSink, first: threading.Event) -> None:
        super().__init__(encoder, sink)
        self._first = first

    def take(self, data: bytes, keyframe: bool, timestamp_us: int | None) -> None:
        super().take(data, keyframe, timestamp_us)
        if not self._first.is_set() and self.n_packets:
            self._first.set()


def _thread_alive(picam2: Any) -> bool:
    """Tell whether picamera2's event loop still runs, or was never started."""
    # picamera2 has no public way to ask: its null preview owns the thread.
    thread = getattr(getattr(picam2, "_preview", None), "thread", None)
    return thread is None or bool(thread.is_alive())


def _import_picamera2() -> tuple[Any, Any, Any]:
    require(
        "picamera2",
        PICAMERA2_MINIMUM,
        why="older ones lose frames or their times",
        remedy=_INSTALL,
    )
    try:
        import libcamera
        import picamera2
        import picamera2.encoders
    except ImportError as e:
        raise HardwareError(
            f"camera: picamera2 does not import: {e}. It must come from the distribution: {_INSTALL}"
        ) from e
    return libcamera, picamera2, picamera2.encoders


def _choose(cameras: list[dict[str, Any]], number: int) -> tuple[str, str]:
    """Return libcamera's id and the sensor's model of a camera."""
    if not 0 <= number < len(cameras):
        raise HardwareError(
            f"camera {number} does not exist: libcamera finds {len(cameras)}. Check the ribbon cable and "
            "'rpicam-hello --list-cameras'; after plugging, reboot"
        )
    return str(cameras[number]["Id"]), str(cameras[number]["Model"])


def _is_out_of_memory(e: Exception) -> bool:
    return getattr(e, "errno", None) == errno.ENOMEM or "allocate" in str(e).lower()


def _because(e: Exception | None) -> str:
    return "" if e is None else f" ({e})"


def _advice(e: Exception) -> str:
    text = str(e).lower()
    if "busy" in text or "did not complete" in text or getattr(e, "errno", None) == errno.EBUSY:
        return ". Is another program using the camera? 'sudo fuser -v /dev/media* /dev/video*' names it"
    if getattr(e, "errno", None) in (errno.EACCES, errno.EPERM) or "dmaheap" in text:
        return ". The user needs the group 'video': sudo usermod -aG video USER"
    return ""
