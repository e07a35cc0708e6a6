"""`bricktrackd start-test`: how long a cold camera takes from the command to its first frame.

A run of bricktrack does not wait for this: its camera streams from arming. The figure is for comparison with
the source paper's recordings, which began at the trigger, and for units that must start cold.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import pairwise
from statistics import median

from rich.console import Console
from rich.table import Table

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import HardwareError
from bricktrack_device.config import DeviceConfig
from bricktrack_device.interfaces import EncodedPacket, FrameMetadata, Rig
from bricktrack_device.timing.result_file import Result, make_result
from bricktrack_device.timing.start_estimate import StartEstimate, estimate_start, initialisation_ms
from bricktrack_device.timing.text_histogram import text_histogram

PAPER_MEAN_MS, PAPER_SD_MS = 285.7, 16.86
_FRAMES_COUNTED = 20
_START_S = 40.0
_PHASES = 7
MAX_LOST_SHARE = 0.5
"""With more frames lost than this of a start's, its count is not believed."""
_GRID_TOLERANCE = 0.2

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class Start:
    """One cold start; times count from the command, ms.

    Attributes
    ----------
    first_frame_ms : float
        Start of read-out of the first frame that the sensor delivered.
    first_packet_ms : float
        The same of the first frame that was encoded: after the controls were checked.
    counted_ms : float
        The first of these from the count of frames in a window, as the source paper does.
    n_frames : int
        Frames that the sensor made in the window; ``window_ms`` is its length.
    n_lost : int
        How many of them never arrived: their places are told by the stamps beside them. A frame that was
        lost before the first one cannot be told.
    """

    first_frame_ms: float
    first_packet_ms: float
    counted_ms: float
    n_frames: int
    n_lost: int
    window_ms: float
    period_ms: float


class _StampSink:
    """Keeps stamps only."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.frames_ns: list[int] = []
        self.first_packet_us: int | None = None

    def on_packet(self, packet: EncodedPacket) -> None:
        """Keep the first stamp."""
        if self.first_packet_us is None:
            self.first_packet_us = packet.abs_us

    def on_metadata(self, metadata: FrameMetadata) -> None:
        """Keep the stamp."""
        with self.lock:
            self.frames_ns.append(metadata.sensor_timestamp_ns)

    def stamps(self) -> list[int]:
        """Return the frames' stamps so far."""
        with self.lock:
            return list(self.frames_ns)


def start_once(rig: Rig, *, frame_period_s: float, extra_window_ms: float = 0.0) -> Start:
    """Start the camera cold, count frames for a while, stop it.

    Parameters
    ----------
    rig : Rig
    frame_period_s : float
        As configured, for how long to wait.
    extra_window_ms : float
        Added to the window, so that its end does not always fall on the same phase of the frames.

    Raises
    ------
    HardwareError
        If the camera does not start, or more frames are lost than `MAX_LOST_SHARE`.
    """
    sink = _StampSink()
    command_ns = monotonic_ns()
    camera = rig.open_camera()
    try:
        section = camera.start(sink)
        deadline = time.monotonic() + _START_S
        while len(sink.stamps()) < _FRAMES_COUNTED or sink.first_packet_us is None:
            if time.monotonic() > deadline:
                raise HardwareError(
                    f"{section.model}: {len(sink.stamps())} frames in {_START_S:g} s; expected more than "
                    f"{_FRAMES_COUNTED}. Run 'bricktrackd check'"
                )
            time.sleep(frame_period_s / 4)
        window_ns = monotonic_ns() - command_ns + round(extra_window_ms * 1e6)
        # A frame's stamp is the start of its read-out: it is delivered one or two periods later.
        time.sleep(extra_window_ms / 1e3 + 6 * frame_period_s)
    finally:
        camera.stop()
    return evaluate_start(
        sink.stamps(),
        first_packet_us=sink.first_packet_us,
        command_ns=command_ns,
        window_ns=window_ns,
        period_ns=section.frame_duration_us * 1000,
    )


def evaluate_start(
    stamps_ns: list[int], *, first_packet_us: int, command_ns: int, window_ns: int, period_ns: int
) -> Start:
    """Return one start's times from its frames' stamps; lost frames are counted by the gaps that they left.

    Parameters
    ----------
    stamps_ns : list of int
        In order; some of them behind the window, so that what is lost at its end is seen.
    period_ns : int
        Between frames, as the camera says.

    Raises
    ------
    HardwareError
        If the stamps are not on one grid of frames, or more are lost than `MAX_LOST_SHARE`.
    """
    places = [0]
    for before, after in pairwise(stamps_ns):
        steps = (after - before) / period_ns
        if round(steps) < 1 or abs(steps - round(steps)) > _GRID_TOLERANCE:
            raise HardwareError(
                f"two frames are {(after - before) / 1e6:.2f} ms apart; expected multiples of "
                f"{period_ns / 1e6:.2f} ms. Run 'bricktrackd check'"
            )
        places.append(places[-1] + round(steps))
    end_ns = command_ns + window_ns
    n_arrived = sum(t <= end_ns for t in stamps_ns)
    if n_arrived < 2:
        raise HardwareError(f"{n_arrived} frames in {window_ns / 1e6:.0f} ms. Run 'bricktrackd check'")
    span_ns = stamps_ns[-1] - stamps_ns[0]
    period_fit_ns = span_ns / places[-1]
    last = places[n_arrived - 1]
    if n_arrived < len(places):  # frames that were lost between the last one and the window's end
        inside = int((end_ns - stamps_ns[n_arrived - 1]) / period_fit_ns)
        last = min(last + inside, places[n_arrived] - 1)
    n_frames = last + 1
    n_lost = n_frames - n_arrived
    if n_lost > MAX_LOST_SHARE * n_frames:
        raise HardwareError(
            f"{n_lost} of {n_frames} frames were lost; at most {100 * MAX_LOST_SHARE:.0f} % may be. Stop "
            "other programs and repeat"
        )
    period_ms, window_ms = period_fit_ns / 1e6, window_ns / 1e6
    return Start(
        first_frame_ms=(stamps_ns[0] - command_ns) / 1e6,
        first_packet_ms=(first_packet_us * 1000 - command_ns) / 1e6,
        counted_ms=initialisation_ms(window_ms, n_frames, period_ms),
        n_frames=n_frames,
        n_lost=n_lost,
        window_ms=window_ms,
        period_ms=period_ms,
    )


def run_start_test(
    config: DeviceConfig, rig: Rig, *, n_runs: int, progress: Progress = lambda share: None
) -> Result:
    """Start the camera ``n_runs`` times and return the result."""
    period_s = 1 / config.camera.frame_rate_hz
    starts: list[Start] = []
    problems: list[str] = []
    for k in range(n_runs):
        try:
            extra_ms = 1000 * period_s * (k % _PHASES) / _PHASES
            starts.append(start_once(rig, frame_period_s=period_s, extra_window_ms=extra_ms))
        except HardwareError as e:
            problems.append(f"run {k + 1}: {e}")
            if len(problems) > max(2, n_runs // 4):
                raise HardwareError(f"too many starts failed; the last: {e}") from e
        progress((k + 1) / n_runs)
    if len(starts) < 2:
        raise HardwareError(f"{len(starts)} starts succeeded; two are needed. {'; '.join(problems)}")
    period_ms = median(s.period_ms for s in starts)
    by_method = {
        "counted": estimate_start([s.counted_ms for s in starts], period_ms),
        "first_frame": estimate_start([s.first_frame_ms for s in starts], 0.0),
        "first_packet": estimate_start([s.first_packet_ms for s in starts], 0.0),
    }
    columns = [asdict(s) for s in starts]
    return make_result(
        "start-test",
        config.unit.name,
        rig,
        settings={
            "runs": n_runs,
            "period_ms": period_ms,
            "frames": sum(s.n_frames for s in starts),
            "frames_lost": sum(s.n_lost for s in starts),
            "failed": problems,
        },
        figures={name: asdict(e) for name, e in by_method.items()},
        values={key: [c[key] for c in columns] for key in columns[0]},
    )


def print_report(result: Result, console: Console | None = None) -> None:
    """Print a test for people."""
    console = console or Console()
    simulated = ", SIMULATED: no camera's figures" if result.simulated else ""
    console.print(f"start-test of {result.unit}{simulated}", markup=False, highlight=False)
    runs = Table("run", "first frame, ms", "by count, ms", "frames", "in, ms", "first encoded, ms", box=None)
    v = result.values
    for i in range(len(v["counted_ms"])):
        runs.add_row(
            str(i + 1), f"{v['first_frame_ms'][i]:.2f}", f"{v['counted_ms'][i]:.2f}", str(v["n_frames"][i]),
            f"{v['window_ms'][i]:.2f}", f"{v['first_packet_ms'][i]:.2f}",
        )  # fmt: skip
    console.print(runs)
    table = Table("initialisation time", "mean, ms", "standard error", "sd, ms", "sd corrected, ms", box=None)
    for name, label in (
        ("first_frame", "to the first frame, by its stamp"),
        ("counted", "the same by counting (eqs 28-30)"),
        ("first_packet", "to the first encoded frame"),
    ):
        e = StartEstimate(**result.figures[name])
        table.add_row(
            label, f"{e.mean_ms:.1f}", f"{e.mean_standard_error_ms:.1f}", f"{e.sd_ms:.2f}",
            f"{e.sd_corrected_ms:.2f}",
        )  # fmt: skip
    table.add_row("the source paper, by counting", f"{PAPER_MEAN_MS}", "", f"{PAPER_SD_MS}", "")
    console.print(table)
    if result.settings["frames_lost"]:
        console.print(
            f"{result.settings['frames_lost']} of {result.settings['frames']} frames were lost; the count "
            "takes their places from the stamps beside them",
            style="yellow", markup=False, highlight=False,
        )  # fmt: skip
    for words in result.settings["failed"]:
        console.print(words, style="yellow", markup=False, highlight=False)
    console.print("\nto the first frame, by its stamp:", highlight=False)
    for line in text_histogram(v["first_frame_ms"], unit="ms", n_bins=8):
        console.print(line, markup=False, highlight=False)
