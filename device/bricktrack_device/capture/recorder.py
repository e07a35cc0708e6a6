"""The unit's one thread of control: armed, recording, saving, one run at a time.

Everything that changes the state happens in this thread; commands come in through a queue and are answered
through the callback that they bring.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import BricktrackError, StorageError
from bricktrack_common.wire_messages import Armed, DaemonState, Disarmed
from bricktrack_device.capture.arming import new_session
from bricktrack_device.capture.black_box import BlackBox, black_box_folder
from bricktrack_device.capture.commands import (
    Answer,
    ArmCommand,
    Command,
    DisarmCommand,
    Inbox,
    OtherWork,
    put_unless_many,
    refusal_of,
    refuse_all,
)
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

_TICK_S = 0.02
_IDLE_TICK_S = 0.2
_RETRY_S = 10.0


class _StoppingError(BricktrackError):
    """The daemon is told to end while it waits for a sensor."""


class Recorder:
    """See the module's first lines.

    Parameters
    ----------
    config : DeviceConfig
    rig : Rig
    store : RunStore
    """

    def __init__(self, config: DeviceConfig, rig: Rig, store: RunStore) -> None:
        self._config = config
        self._rig = rig
        self._store = store
        self._machine = StateMachine()
        self._inbox: Inbox = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="recorder")
        self._stopping = threading.Event()
        self._session: Session | None = None
        self._black_box = BlackBox(black_box_folder(config))
        self._kept = KeptRun(store, rig, self._black_box)
        self._order = StandingOrder(self._black_box.folder, config.unit.name)
        self._auto_arm = config.recording.auto_arm
        self._lost = LostSensors()
        self._try_again_at = 0.0
        self._last_error = ""
        self._doing = ""
        self._lost_camera = ""
        self._light = RunLight(config.leds, rig)
        self._last_beat = time.monotonic()

    # From other threads

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End: a recording under way is saved as far as it got, and marked. Returns when that is done."""
        self._stopping.set()
        self._inbox.put(None)
        if self._thread.ident is not None:
            self._thread.join()

    def arm(self, label: str, duration_s: float | None, answer: Answer) -> None:
        """Ask to arm; answered with `Armed` when the unit is ready, or a `Refusal`."""
        self._inbox.put(ArmCommand(ArmOrder(label=label, duration_s=duration_s), answer))

    def disarm(self, answer: Answer) -> None:
        """Ask to go back to idle, or to leave a fault; answered with `Disarmed` or a `Refusal`."""
        self._inbox.put(DisarmCommand(answer))

    def do_when_idle(self, doing: str, work: Callable[[], None], answer: Answer) -> None:
        """Ask to do other work with the unit's sensors, in this thread, while nothing is recorded.

        ``work`` calls `beat` while it waits and answers by itself; ``answer`` gets the `Refusal` if the unit
        is armed, records or saves, or the work raises. ``doing`` says in the status what is going on.
        """
        put_unless_many(self._inbox, OtherWork(doing, work, answer))

    @property
    def state(self) -> DaemonState:
        """The present state."""
        return self._machine.state

    @property
    def beat_age_s(self) -> float:
        """Seconds since the thread was last seen at work; infinite once it is gone."""
        return time.monotonic() - self._last_beat if self._thread.is_alive() else float("inf")

    def status(self) -> RecorderStatus:
        """Return how things are."""
        return status_of(
            self._session,
            self.state,
            self._machine.reason or self._doing,
            last_error=self._last_error,
            disk_needed_bytes=disk_needed_bytes(self._config),
            auto_arm=self._auto_arm,
        )

    @property
    def restart_reason(self) -> str:
        """Why only a restart of the process helps, in words; empty while it does not, or holds a run."""
        return "" if self._session or self._kept.run_id else self._lost_camera

    # The thread

    def _run(self) -> None:
        try:
            self._light.put_out_leftovers()
        except Exception:
            logger.exception("a bug in putting the LEDs out")
        self._order.take_up()
        while not self._stopping.is_set():
            self._last_beat = time.monotonic()
            try:
                command = self._inbox.get(timeout=_TICK_S if self._session else _IDLE_TICK_S)
            except queue.Empty:
                command = None
            try:
                if command is not None:
                    self._obey(command)
                self._go_on()
            except Exception as e:  # noqa: BLE001  logged there, or noted in the run under way
                self._go_on_after(e)
        self._end()

    def beat(self) -> None:
        """Say that the thread is at work; give up waiting when the daemon is told to end."""
        self._last_beat = time.monotonic()
        if self._stopping.is_set():
            raise _StoppingError("the daemon is stopping")

    def _obey(self, command: Command) -> None:
        try:
            if isinstance(command, ArmCommand):
                session = self._arm(self._order.supersede(command.order))
                self._order.note(command.order)
                self._auto_arm = self._config.recording.auto_arm
                command.answer(Armed(run_id=session.run_id, missing=[m[:2000] for m in session.missing]))
            elif isinstance(command, DisarmCommand):
                self._disarm()
                command.answer(Disarmed())
            else:
                self._do(command)
        except Exception as e:
            command.answer(refusal_of(e))
            if not isinstance(e, BricktrackError):
                raise

    def _go_on(self) -> None:
        """Do what is due in the present state."""
        session = self._session
        if session is not None:
            session.poll()
            if self.state == "armed":
                if session.t0_ns is not None:
                    self._change("first-edge")
                    session.note_trigger()
                    self._black_box.begin(session.run_id, self._config.video_bytes(session.duration_s))
                    self._black_box.take_if_due(session.so_far)
                    self._order.forget()
                elif words := self._lost.words(session, auto_arm=self._auto_arm):
                    self._fail(words)
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

    # Arming and disarming

    def _arm_by_itself(self) -> None:
        left = self._order.left
        self._arm(left or ArmOrder(label=self._config.recording.label, duration_s=None))
        if left is not None:
            self._order.note(left)

    def _arm(self, order: ArmOrder) -> Session:
        self._machine.require("arm", run_id=self._run_id)
        self._doing = "arming"
        try:
            session = self._session = new_session(
                self._config,
                self._rig,
                self._store,
                self._black_box,
                label=order.label,
                duration_s=order.duration_s or self._config.recording.duration_s,
                light=self._light,
                beat=self.beat,
            )
            try:
                session.open(lambda: self._inbox.put(None))
            except BaseException:
                self._close_session()
                self._light.put_out()
                raise
        finally:
            self._doing = ""
        self._last_error = ""
        self._lost = LostSensors()
        if order is self._order.left:
            session.note_armed_again()
        self._change("arm")
        return session

    def _disarm(self) -> None:
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

    def _do(self, command: OtherWork) -> None:
        if self.state not in ("idle", "fault"):
            raise RequestRefusedError(
                "busy", f"the unit is {self.state}; {command.doing} waits until it is idle"
            )
        self._doing = command.doing
        try:
            command.work()
        finally:
            self._doing = ""

    def configure(self, config: DeviceConfig) -> None:
        """Work by another configuration from now on; to be called from `do_when_idle`."""
        if config.recording.auto_arm != self._config.recording.auto_arm:
            self._auto_arm = config.recording.auto_arm
        self._config = config

    def note_lost_camera(self, words: str) -> None:
        """Hear why only a new start of the daemon gives the camera back; ``""`` says that it is not so."""
        self._lost_camera = self._lost_camera or words

    # Ending a run

    def _finish(self, *, interrupted: str = "") -> None:
        session = self._session
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

    def _end(self) -> None:
        """Leave everything in order when the daemon stops."""
        try:
            if self.state == "recording" and self._session is not None:
                seconds = (monotonic_ns() - (self._session.t0_ns or 0)) / 1e9
                self._finish(interrupted=f"the daemon was stopped {seconds:.1f} s after t = 0")
            elif self.state == "armed":
                self._order.forget()
                self._close_session()
                self._change("stop")
            elif self._kept.run_id:
                self._save_again()
        except Exception:
            logger.exception("a bug in the recorder while it ends")
        finally:
            self._close_session()
            self._light.put_out()
        if self._kept.run_id:
            logger.error("%s: %s", self._kept.run_id, self._kept.fate)
        refuse_all(self._inbox, "the daemon is stopping")

    def _go_on_after(self, bug: Exception) -> None:
        """Go to fault after a bug, but not before a recording under way has ended and is on the card."""
        words = f"internal error: {type(bug).__name__}: {bug}"
        session = self._session
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

    def _fail(self, reason: str) -> None:
        """Go to fault from wherever the unit is."""
        self._try_again_at = time.monotonic() + _RETRY_S
        self._note_error(reason)
        self._order.forget()
        self._close_session()
        self._change("failure", reason=reason)

    @property
    def _run_id(self) -> str:
        return self._session.run_id if self._session else ""

    def _close_session(self) -> None:
        session, self._session = self._session, None
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
