"""From armed to recording to saved, one run at a time: what the unit does in each of its states.

Used by the recorder's thread alone; `RunCycle.status` and what it reads are safe from others.
"""

import logging
import time
from collections.abc import Callable

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import BricktrackError, StorageError
from bricktrack_common.wire_messages import DaemonState
from bricktrack_device.capture.arming import BringIn, new_session
from bricktrack_device.capture.black_box import BlackBox, black_box_folder
from bricktrack_device.capture.kept_run import KeptRun
from bricktrack_device.capture.lost_sensors import LostSensors
from bricktrack_device.capture.recorder_status import RecorderStatus, status_of
from bricktrack_device.capture.room import disk_needed_bytes
from bricktrack_device.capture.run_light import RunLight
from bricktrack_device.capture.session import Session
from bricktrack_device.capture.standing_order import ArmOrder, StandingOrder
from bricktrack_device.capture.state_table import Cause, StateMachine
from bricktrack_device.config import DeviceConfig
from bricktrack_device.interfaces import Rig
from bricktrack_device.refusals import RequestRefusedError
from bricktrack_device.storage.run_store import RunStore

logger = logging.getLogger(__name__)

_RETRY_S = 10.0


class RunCycle:
    """See the module's first lines.

    Parameters
    ----------
    config : DeviceConfig
    rig : Rig
    store : RunStore
    beat : callable
        Called while waiting for sensors and the card; raises to give up.
    wake : callable
        Called from any thread when the first edge has come, so that `go_on` is called soon.

    Attributes
    ----------
    session : Session or None
        The sensors of the run that is waited for or recorded.
    """

    def __init__(
        self,
        config: DeviceConfig,
        rig: Rig,
        store: RunStore,
        *,
        beat: Callable[[], None],
        wake: Callable[[], None],
    ) -> None:
        self._config = config
        self._rig = rig
        self._store = store
        self._beat = beat
        self._wake = wake
        self._machine = StateMachine()
        self.session: Session | None = None
        self._black_box = BlackBox(black_box_folder(config))
        self._bring_in = BringIn(self._black_box, store)
        self._kept = KeptRun(store, rig, self._black_box)
        self._order = StandingOrder(
            self._black_box.folder,
            config.unit.name,
            max_age_s=config.recording.arm_again_within_s,
            has_run=lambda run_id: store.has(run_id) or self._black_box.has(run_id),
        )
        self._auto_arm = config.recording.auto_arm
        self._lost = LostSensors()
        self._try_again_at = 0.0
        self._last_error = ""
        self._doing = ""
        self._lost_camera = ""
        self._light = RunLight(config.leds, rig)

    @property
    def state(self) -> DaemonState:
        """The present state."""
        return self._machine.state

    def status(self) -> RecorderStatus:
        """Return how things are."""
        return status_of(
            self.session,
            self.state,
            self._machine.reason or self._doing,
            last_error=self._last_error,
            disk_needed_bytes=disk_needed_bytes(self._config),
            auto_arm=self._auto_arm,
        )

    @property
    def restart_reason(self) -> str:
        """Why only a restart of the process helps, in words; empty while it does not, or holds a run."""
        return "" if self.session or self._kept.run_id else self._lost_camera

    @property
    def will_arm_again(self) -> bool:
        """Whether `begin` takes up what a killed daemon was armed for."""
        return self._order.stands

    def begin(self) -> None:
        """Take up what a killed daemon left, before anything else."""
        try:
            self._light.put_out_leftovers()
        except Exception:
            logger.exception("a bug in putting the LEDs out")
        if words := self._order.take_up():
            self._note_error(words)

    def go_on(self) -> None:
        """Do what is due in the present state."""
        session = self.session
        if session is not None:
            session.poll()
            if self.state == "armed":
                if session.t0_ns is not None:
                    self._begin_run(session)
                elif words := self._lost.words(session, auto_arm=self._auto_arm):
                    self._fail_armed(words)
            elif self.state == "recording":
                self._black_box.take_if_due(session.so_far)
                if session.is_over(monotonic_ns()):
                    self._finish()
        elif time.monotonic() < self._try_again_at:
            return
        elif self.state == "fault" and self._kept.run_id:
            self._try_again_at = time.monotonic() + _RETRY_S
            if self._kept.has_room():
                self._save_again()
        elif self.state == "fault" and self._auto_arm:
            self._change("disarm")
        elif self.state == "idle" and (self._order.left or self._auto_arm):
            self._try_again_at = time.monotonic() + _RETRY_S
            try:
                self._arm_by_itself()
            except BricktrackError as e:
                self._note_error(f"cannot arm itself: {e}")

    def _begin_run(self, session: Session) -> None:
        """Note the first edge; a bug in that costs neither the run's copy nor lets its order stand."""
        self._change("first-edge")
        try:
            session.note_trigger()
        finally:
            try:
                self._black_box.begin(session.run_id, self._config.video_bytes(session.duration_s))
                self._black_box.take_if_due(session.so_far)
            finally:
                self._order.forget()

    # Arming and disarming

    def arm(self, order: ArmOrder) -> Session:
        """Get ready for the next first edge, at a host's command; return the run's sensors.

        Raises
        ------
        BricktrackError
            If it cannot be armed now.
        """
        session = self._arm(self._order.supersede(order))
        self._order.note(order, session.run_id)
        self._auto_arm = self._config.recording.auto_arm
        return session

    def _arm_by_itself(self) -> None:
        left = self._order.left
        own = ArmOrder(label=self._config.recording.label, duration_s=None)
        session = self._arm(left or own, again=self._order.why)
        if left is not None:
            self._order.note(left, session.run_id)
        else:
            self._order.forget()

    def _arm(self, order: ArmOrder, *, again: str = "") -> Session:
        self._machine.require("arm", run_id=self._run_id)
        self._doing = "arming"
        try:
            session = self.session = new_session(
                self._config,
                self._rig,
                self._store,
                self._bring_in,
                label=order.label,
                duration_s=order.duration_s or self._config.recording.duration_s,
                light=self._light,
                beat=self._beat,
            )
            try:
                session.open(self._wake)
            except BaseException:
                self._close_session()
                self._light.put_out()
                raise
        finally:
            self._doing = ""
        self._last_error = ""
        self._lost = LostSensors()
        if again:
            session.note_armed_again(again)
        self._change("arm")
        return session

    def disarm(self) -> None:
        """Go back to idle, or leave a fault, at a host's command.

        Raises
        ------
        RequestRefusedError
            If a run is under way, or still only in memory.
        """
        if self.state == "fault" and self._kept.run_id:
            self._save_again()
            if self._kept.run_id:
                raise RequestRefusedError(
                    "no-space", f"run {self._kept.run_id} is still only in memory: {self._machine.reason}"
                )
        self._auto_arm = False
        self._order.forget()
        if self.state == "idle":
            return
        self._machine.require("disarm", run_id=self._run_id)
        self._close_session()
        self._change("disarm")

    def do(self, doing: str, work: Callable[[], None]) -> None:
        """Do other work with the unit's sensors; refused with ``busy`` while the unit is about a run."""
        if self.state not in ("idle", "fault"):
            raise RequestRefusedError("busy", f"the unit is {self.state}; {doing} waits until it is idle")
        self._doing = doing
        try:
            work()
        finally:
            self._doing = ""

    def configure(self, config: DeviceConfig) -> None:
        """Work by another configuration from now on, while nothing is recorded."""
        if config.recording.auto_arm != self._config.recording.auto_arm:
            self._auto_arm = config.recording.auto_arm
        self._config = config

    def note_lost_camera(self, words: str) -> None:
        """Hear why only a new start of the daemon gives the camera back; ``""`` says that it is not so."""
        self._lost_camera = self._lost_camera or words

    # Ending a run

    def _finish(self, *, interrupted: str = "") -> None:
        session = self.session
        if session is None:
            return
        # Held from here on, whatever the sensors do when they are let go.
        self._kept.keep(session.collect(interrupted=interrupted))
        ended = time.monotonic()
        self._change("stop" if interrupted else "window-over")
        self._close_session()
        closed = time.monotonic()
        if self._save_kept():
            logger.info(
                "%s: saved %.2f s after the recording ended (%.2f s of it to stop the sensors)",
                session.run_id, time.monotonic() - ended, closed - ended,
            )  # fmt: skip

    def _save_again(self) -> None:
        self._change("save-again")
        self._save_kept()

    def _save_kept(self) -> bool:
        """Save the run that is held; go to fault, and hold it, where the card does not take it."""
        try:
            saved = self._kept.save()
        except StorageError as e:
            self._try_again_at = time.monotonic() + _RETRY_S
            reason = f"{e}. The run is kept in memory and saved when that works again"
            self._note_error(reason)
            self._change("save-failed", reason=reason)
            return False
        self._try_again_at = 0.0
        self._change("saved", run_id=saved.run_id)
        if saved.missing:
            logger.warning(
                "%s: %d things are missing or wrong, as its manifest says; the last: %s",
                saved.run_id, len(saved.missing), saved.missing[-1],
            )  # fmt: skip
        return True

    def end(self) -> None:
        """Leave everything in order when the daemon stops."""
        try:
            if self.state == "recording" and self.session is not None:
                seconds = (monotonic_ns() - (self.session.t0_ns or 0)) / 1e9
                self._finish(interrupted=f"the daemon was stopped {seconds:.1f} s after t = 0")
            elif self.state == "armed":
                self._close_session()
                self._change("stop")
            elif self._kept.run_id:
                self._save_again()
        except Exception:
            logger.exception("a bug in the recorder while it ends")
        finally:
            self._order.forget()
            self._close_session()
            self._light.put_out()
        if self._kept.run_id:
            logger.error("%s: %s", self._kept.run_id, self._kept.fate)

    def go_on_after(self, bug: Exception) -> None:
        """Go to fault after a bug, but not before a recording under way has ended and is on the card."""
        words = f"internal error: {type(bug).__name__}: {bug}"
        session = self.session
        if self.state == "recording" and session is not None:
            if session.note_bug(words):
                logger.error("%s: a bug; the recording goes on", session.run_id, exc_info=bug)
            if not session.is_surely_over(monotonic_ns()):
                return  # the sensors stream without this thread
            try:
                self._finish()
            except Exception:
                logger.exception("a second bug, while the recording was saved")
        else:
            logger.error("a bug in the recorder", exc_info=bug)
        self._fail(words)

    def _fail_armed(self, reason: str) -> None:
        """Go to fault because of lost sensors; a unit that arms itself does so for the same order again."""
        if not self._auto_arm:
            return self._fail(reason)
        self._order.arm_again(reason)
        self._go_to_fault(f"{reason}. The unit will arm itself again")

    def _fail(self, reason: str) -> None:
        """Go to fault from wherever the unit is."""
        self._order.forget()
        self._go_to_fault(reason)

    def _go_to_fault(self, reason: str) -> None:
        self._try_again_at = time.monotonic() + _RETRY_S
        self._note_error(reason)
        self._close_session()
        self._change("failure", reason=reason)

    @property
    def _run_id(self) -> str:
        return self.session.run_id if self.session else ""

    def _close_session(self) -> None:
        session, self.session = self.session, None
        if session is not None:
            session.close()
            self.note_lost_camera(session.camera.lost)

    def _change(self, cause: Cause, *, reason: str = "", run_id: str = "") -> None:
        change = self._machine.change(cause, reason=reason)
        if change.after in ("idle", "fault"):
            self._light.put_out()
        of_run = run_id or self._run_id
        logger.info(
            "%s -> %s (%s)%s%s",
            change.before, change.after, change.cause, f" {of_run}" if of_run else "",
            f": {reason}" if reason else "",
        )  # fmt: skip

    def _note_error(self, words: str) -> None:
        if words != self._last_error:
            logger.warning("%s", words)
        self._last_error = words[:2000]
