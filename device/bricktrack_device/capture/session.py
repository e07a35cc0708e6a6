"""All the sensors of one run, streaming from arming on: started together, watched, cut, and let go.

One sensor failing stops no other: it is noted in words, and the run says what is missing.
"""

import logging
import time
from collections.abc import Callable
from functools import partial
from typing import Literal, TypeVar

from bricktrack_common.clocks import ClockTriplet, monotonic_ns, read_clock_triplet
from bricktrack_common.errors import BricktrackError, HardwareError
from bricktrack_common.run_manifest import ClocksSection, WaveSection
from bricktrack_device.capture.camera_stream import CameraStream
from bricktrack_device.capture.edge_report import judge_edges
from bricktrack_device.capture.part_by_part import unless_a_bug
from bricktrack_device.capture.recording import ImuRecording, Recording, RunLog
from bricktrack_device.capture.ring import RING_SLACK_S
from bricktrack_device.capture.run_light import RunLight
from bricktrack_device.capture.trigger import EdgeTrain, Trigger
from bricktrack_device.config import DeviceConfig
from bricktrack_device.inertial.imu_reader import ImuReader
from bricktrack_device.interfaces import Rig
from bricktrack_device.refusals import RequestRefusedError

logger = logging.getLogger(__name__)

LATE_FRAMES_GRACE_S = 1.0
"""How long after the window's end the last pictures may still come out of the encoder."""
LATE_EDGES_GRACE_NS = 100_000_000
"""How long after the window's end edges that were stamped within it may still be reported."""
_STUCK_HIGH_NS = 5_000_000_000
_UNDER_WAY_NS = 300_000_000
"""So new pictures may still be in the encoder, and their metadata on the way."""
_POLL_S = 0.01
_MOST_BUGS = 20
"""Noted of a run: words that hold a number may be new ones in every tick."""

T = TypeVar("T")


class Session:
    """The sensors of one run.

    Parameters
    ----------
    config : DeviceConfig
    rig : Rig
    run_id, label : str
    duration_s : float
    light : RunLight
        Lit when the session opens; whoever owns it puts it out.
    beat : callable
        Called while waiting; raises to give up.
    """

    def __init__(
        self,
        config: DeviceConfig,
        rig: Rig,
        *,
        run_id: str,
        label: str,
        duration_s: float,
        light: RunLight,
        beat: Callable[[], None],
    ) -> None:
        self.run_id = run_id
        self.label = label
        self.duration_s = duration_s
        self.missing: list[str] = []
        self.log = RunLog()
        self._config = config
        self._rig = rig
        self._light = light
        self._beat = beat
        span_s = config.span_s(duration_s) + RING_SLACK_S
        keyframe_s = config.camera.iperiod / config.camera.frame_rate_hz
        self.camera = CameraStream(rig.open_camera, round((span_s + keyframe_s) * 1e9), beat=beat)
        self._imu_span_s = span_s
        self.imus: list[ImuReader] = []
        self.trigger: Trigger | None = None
        self._described: dict[str, str] = {}
        self._line_told = False
        self._n_bugs = 0
        self._t_armed_ns = 0
        self._arm_triplet: ClockTriplet | None = None
        self._trigger_triplet: ClockTriplet | None = None

    # Arming

    def open(self, on_first_edge: Callable[[], None]) -> None:
        """Start every sensor, wait until they deliver, then watch the trigger.

        Raises
        ------
        RequestRefusedError
            If a required sensor does not start, or none does.
        HardwareError
            If the trigger's pin cannot be had.
        """
        for table in self._config.imu:
            reader = ImuReader(
                table,
                self._rig.bus_opener(table.bus),
                self._config.sampler,
                span_s=self._imu_span_s,
                calibration_folder=self._config.calibration_folder,
            )
            self.imus.append(reader)
            reader.start()
        self._light_leds()
        try:
            self._start_camera()
        except BricktrackError as e:
            if self._config.camera.required:
                raise RequestRefusedError("not-ready", f"camera: {e}") from e
            self._note_missing(f"camera: {e}")
        self._wait_for_imus()
        if not self.has_sensors:
            raise RequestRefusedError("not-ready", "no sensor works: " + "; ".join(self.missing))
        self._wait_for_pre_roll()
        self.trigger = Trigger(self._rig.pin_factory(), self._config.trigger)
        self._arm_triplet = read_clock_triplet()
        self._t_armed_ns = self.trigger.arm(on_first_edge)
        self.log.add("armed", run_id=self.run_id, line_is_high=self.trigger.line_is_high)
        self._rig.on_armed(self._t_armed_ns)

    def _light_leds(self) -> None:
        try:
            self._light.light()
        except HardwareError as e:
            if self._config.camera.required:
                raise RequestRefusedError("not-ready", f"leds: {e}") from e
            self._note_missing(f"leds: {e}")
        if self._light.words:
            self.log.add("leds lit", words=self._light.words)

    def _start_camera(self) -> None:
        section = self.camera.start()
        self.log.add("camera started", model=section.model, mode=section.mode.name, encoder=section.encoder)
        self.camera.wait_for_keyframe()

    def _wait_for_imus(self) -> None:
        while any(not i.is_ready and not i.problem for i in self.imus):
            self._beat()
            for reader in self.imus:
                reader.poll()
            time.sleep(_POLL_S)
        for reader in self.imus:
            if reader.problem and reader.settings.required:
                raise RequestRefusedError("not-ready", f"imu {reader.name}: {reader.problem}")
            for words in reader.news():
                self._note_missing(f"imu {reader.name}: {words}")
            if reader.is_ready:
                self.log.add("imu started", name=reader.name, scheduling=reader.scheduling)
                if (found := reader.description()) is not None and found.calibration_restored:
                    self.log.add("imu calibration restored", name=reader.name, chip_id=found.chip_id)
                for words in reader.warnings:
                    logger.warning("imu %s: %s", reader.name, words)
                    self.log.add("imu warning", name=reader.name, words=words)

    def _wait_for_pre_roll(self) -> None:
        """Wait until every sensor that works has delivered for as long as a run looks back."""
        starts_ns = [d.t0_ns for i in self.imus if i.is_ready and (d := i.description()) is not None]
        if not self.camera.problem:
            starts_ns.append((self.camera.ring.first_keyframe_us or 0) * 1000)
        full_ns = max(starts_ns) + round(self._config.recording.pre_roll_s * 1e9)
        while monotonic_ns() < full_ns:
            self._beat()
            time.sleep(_POLL_S)

    # Watching

    @property
    def t0_ns(self) -> int | None:
        """The first edge, once it has come."""
        return None if self.trigger is None else self.trigger.t0_ns

    @property
    def has_sensors(self) -> bool:
        """Whether anything delivers now."""
        return not self.camera.problem or any(i.is_ready and not i.silence for i in self.imus)

    @property
    def lost_required(self) -> str:
        """What the configuration requires and does not deliver now, in words; empty if all is well."""
        lost = [f"imu {i.name}: {i.silence}" for i in self.imus if i.settings.required and i.silence]
        if self._config.camera.required and (problem := self.camera.problem):
            lost.insert(0, f"camera: {problem}")
        return "; ".join(lost)

    @property
    def window_ns(self) -> tuple[int, int]:
        """First and last instant that the run shall hold; around the arming where no edge has come."""
        t0_ns = self.t0_ns or self._t_armed_ns
        r = self._config.recording
        return (
            t0_ns - round(r.pre_roll_s * 1e9),
            t0_ns + round((self.duration_s + r.post_roll_s) * 1e9),
        )

    def poll(self) -> None:
        """See how the sensors are, and note what was lost; they deliver whether or not this works."""
        for name, look in (
            ("line", self._watch_line),
            ("imus", self._watch_imus),
            ("camera", self._watch_camera),
        ):
            self._unless_a_bug(f"watching the {name}", look, None)

    def _watch_imus(self) -> None:
        for reader in self.imus:
            reader.poll(may_give_up=self.t0_ns is None)
            for words in reader.news():
                self._note_missing(f"imu {reader.name}: {words}{self._when()}")

    def _watch_camera(self) -> None:
        for words in self.camera.news():
            self._note_missing(f"{words}{self._when()}")

    def _watch_line(self) -> None:
        """Say once in the log that the line does not rest low."""
        if self._line_told or self.t0_ns is not None or self.trigger is None:
            return
        if monotonic_ns() - self._t_armed_ns > _STUCK_HIGH_NS:
            self._line_told = True
            if self.trigger.line_is_high:
                logger.warning("%s: trigger: %s", self.run_id, self.trigger.waiting_words())
                self.log.add("line not low after arming", words=self.trigger.waiting_words())

    def note_trigger(self) -> None:
        """Log the clocks at the first edge."""
        self._trigger_triplet = read_clock_triplet()
        self.log.add("first edge", t0_ns=self.t0_ns)

    def note_armed_again(self, why: str) -> None:
        """Say that the unit was armed before and was not for a while; ``why`` is in words."""
        self._note_missing(
            f"{why}; the unit armed itself again: edges in between were not heard, t = 0 may be a later one "
            "than the first"
        )

    def note_bug(self, words: str) -> bool:
        """Note that the daemon itself went wrong, and tell whether that is new, and not one of very many."""
        if words in self.missing or self._n_bugs >= _MOST_BUGS:
            return False
        self._n_bugs += 1
        self.missing.append(words)
        self.log.add("bug", words=words)
        return True

    def is_surely_over(self, now_ns: int) -> bool:
        """Tell whether nothing of the run's window can come in any more, by the clock alone."""
        return now_ns > self.window_ns[1] + round(LATE_FRAMES_GRACE_S * 1e9)

    def is_over(self, now_ns: int) -> bool:
        """Tell whether everything of the run's window has come in, or will not any more."""
        end_ns = self.window_ns[1]
        if now_ns < end_ns:
            return False
        if self.is_surely_over(now_ns):
            return True
        pictures_in = bool(self.camera.problem) or (self.camera.ring.newest_us or 0) * 1000 >= end_ns
        newest_edge_ns = self.trigger.newest_edge_ns if self.trigger else None
        edges_in = (newest_edge_ns or 0) >= end_ns or now_ns > end_ns + LATE_EDGES_GRACE_NS
        return pictures_in and edges_in and all(i.has_slot_due_at(end_ns) for i in self.imus)

    # Ending

    def collect(self, *, interrupted: str = "") -> Recording:
        """Cut the run out of what was recorded; ``interrupted`` says in words why it ends early."""
        end = read_clock_triplet()
        if interrupted:
            self.missing.append(interrupted)
            self.log.add("interrupted", words=interrupted)
        if self.trigger is None:
            raise HardwareError("there is no run to collect: the trigger was never watched")
        edges = self.trigger.disarm()
        for t_ns in edges.rejected_ns:
            self.log.add("rising edge before the first that counts", edge_ns=t_ns)
        recording = self._recorded(edges, end, state="interrupted" if interrupted else "complete")
        n_frames = len(recording.video.records) if recording.video else 0
        self.log.add("collected", frames=n_frames, edges=len(edges.edges_ns))
        return recording

    def so_far(self) -> Recording:
        """Return the run as it would be if nothing came after this; the recording goes on."""
        now = read_clock_triplet()
        if self.trigger is None:
            raise HardwareError("there is no run yet: the trigger was never watched")
        recording = self._recorded(
            self.trigger.snapshot(), now, until_ns=now.monotonic_ns - _UNDER_WAY_NS, state="interrupted"
        )
        recording.missing.append(
            f"the daemon was killed while it recorded; this is what it had taken{self._when()}"
        )
        return recording

    def _recorded(
        self,
        edges: EdgeTrain,
        end: ClockTriplet,
        *,
        until_ns: int | None = None,
        state: Literal["complete", "interrupted"],
    ) -> Recording:
        """Cut out what lies in the run's window, up to ``until_ns`` or now."""
        trigger = self.trigger
        start_ns, end_ns = self.window_ns
        until_ns = min(end_ns, until_ns or end.monotonic_ns)
        unknown: tuple[WaveSection, list[str]] = WaveSection(), []
        wave, found = self._unless_a_bug("the wave", lambda: self._judge_edges(edges, until_ns), unknown)
        imus = []
        for reader in self.imus:
            taken = self._unless_a_bug(
                f"imu {reader.name}", partial(_recording_of, reader, start_ns, until_ns), None
            )
            if taken is not None:
                imus.append(taken)
                found += taken.problems()
        video = self._unless_a_bug("video", lambda: self.camera.cut(start_ns, until_ns), None)
        if video is not None:
            found += video.problems
        # Asked once a run: on a small Pi this takes longer than all else here.
        self._described = self._described or self._unless_a_bug("the hardware", self._rig.describe, {})
        hardware = self._described | {
            f"sampler of imu {i.name}": i.scheduling for i in self.imus if i.scheduling
        }
        if self._light.words:
            hardware["leds"] = self._light.words
        return Recording(
            run_id=self.run_id,
            unit=self._config.unit.name,
            label=self.label,
            state=state,
            simulated=self._rig.simulated,
            hardware=hardware,
            camera=self.camera.section,
            video=video,
            imus=imus,
            trigger_pin=trigger.pin_name if trigger else "unknown",
            nominal_hz=self._config.trigger.nominal_hz,
            edges=edges,
            wave=wave,
            clocks=ClocksSection(arm=self._arm_triplet, trigger=self._trigger_triplet, end=end),
            window_ns=(start_ns, end_ns),
            missing=self.missing + edges.problems + found,
            log=self.log,
        )

    def _unless_a_bug(self, what: str, make: Callable[[], T], otherwise: T) -> T:
        return unless_a_bug(what, make, otherwise, note=self.note_bug)

    def _judge_edges(self, edges: EdgeTrain, until_ns: int) -> tuple[WaveSection, list[str]]:
        """Count what is wrong with the wave, and say it in words."""
        return judge_edges(
            edges.edges_ns,
            nominal_hz=self._config.trigger.nominal_hz,
            end_ns=until_ns,
            rejected_ns=edges.rejected_ns,
            line_is_high=self.trigger.line_is_high if self.trigger else None,
        )

    def close(self) -> None:
        """Let go of every sensor, whatever each of them says; what hangs is left behind.

        Never raises: the run that was collected still has to be saved. Calling it twice does no harm.
        """
        steps: list[tuple[str, Callable[[], None]]] = [("camera", self.camera.stop)]
        # A sampler that nobody ends goes on, and keeps its memory.
        steps += [(f"imu {reader.name}", reader.stop) for reader in self.imus]
        if self.trigger is not None:
            steps.insert(0, ("trigger", self.trigger.close))
        for name, let_go in steps:
            try:
                let_go()
            except (BricktrackError, OSError) as e:
                logger.warning("%s: %s", name, e)
            except Exception:
                logger.exception("%s: a bug in letting go of it", name)

    def _note_missing(self, words: str) -> None:
        logger.warning("%s: %s", self.run_id, words)
        self.missing.append(words)
        self.log.add("missing", words=words)

    def _when(self) -> str:
        return "" if self.t0_ns is None else f", {(monotonic_ns() - self.t0_ns) / 1e9:+.1f} s from t = 0"


def _recording_of(reader: ImuReader, start_ns: int, end_ns: int) -> ImuRecording | None:
    """Return one sensor's part of a run; `None` of a sensor that was never set up."""
    description = reader.description()
    if description is None:
        return None
    records = reader.records(start_ns, end_ns)
    return ImuRecording(description, records, len(reader.slots_due(start_ns, end_ns)))
