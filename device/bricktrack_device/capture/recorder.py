"""The unit's one thread of control, and what other threads may ask of it.

Everything that changes the state happens in this thread; commands come in through a queue and are answered
through the callback that they bring.
"""

import logging
import queue
import threading
import time
from collections.abc import Callable

from bricktrack_common.errors import BricktrackError
from bricktrack_common.wire_messages import Armed, DaemonState, Disarmed
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
from bricktrack_device.capture.recorder_status import RecorderStatus
from bricktrack_device.capture.run_cycle import RunCycle
from bricktrack_device.capture.standing_order import ArmOrder
from bricktrack_device.config import DeviceConfig
from bricktrack_device.interfaces import Rig
from bricktrack_device.storage.run_store import RunStore

logger = logging.getLogger(__name__)

_TICK_S = 0.02
_IDLE_TICK_S = 0.2


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
        self._inbox: Inbox = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="recorder")
        self._stopping = threading.Event()
        self._cycle = RunCycle(config, rig, store, beat=self.beat, wake=lambda: self._inbox.put(None))
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
        return self._cycle.state

    @property
    def beat_age_s(self) -> float:
        """Seconds since the thread was last seen at work; infinite once it is gone."""
        return time.monotonic() - self._last_beat if self._thread.is_alive() else float("inf")

    def status(self) -> RecorderStatus:
        """Return how things are."""
        return self._cycle.status()

    @property
    def restart_reason(self) -> str:
        """Why only a restart of the process helps, in words; empty while it does not, or holds a run."""
        return self._cycle.restart_reason

    @property
    def will_arm_again(self) -> bool:
        """Whether, once started, it arms for what a killed daemon was armed for."""
        return self._cycle.will_arm_again

    # The thread

    def _run(self) -> None:
        self._cycle.begin()
        while not self._stopping.is_set():
            self._last_beat = time.monotonic()
            try:
                command = self._inbox.get(timeout=_TICK_S if self._cycle.session else _IDLE_TICK_S)
            except queue.Empty:
                command = None
            try:
                if command is not None:
                    self._obey(command)
                self._cycle.go_on()
            except Exception as e:  # noqa: BLE001  logged there, or noted in the run under way
                self._cycle.go_on_after(e)
        self._cycle.end()
        refuse_all(self._inbox, "the daemon is stopping")

    def beat(self) -> None:
        """Say that the thread is at work; give up waiting when the daemon is told to end."""
        self._last_beat = time.monotonic()
        if self._stopping.is_set():
            raise _StoppingError("the daemon is stopping")

    def _obey(self, command: Command) -> None:
        try:
            if isinstance(command, ArmCommand):
                session = self._cycle.arm(command.order)
                command.answer(Armed(run_id=session.run_id, missing=[m[:2000] for m in session.missing]))
            elif isinstance(command, DisarmCommand):
                self._cycle.disarm()
                command.answer(Disarmed())
            else:
                self._cycle.do(command.doing, command.work)
        except Exception as e:
            command.answer(refusal_of(e))
            if not isinstance(e, BricktrackError):
                raise

    def configure(self, config: DeviceConfig) -> None:
        """Work by another configuration from now on; to be called from `do_when_idle`."""
        self._cycle.configure(config)

    def note_lost_camera(self, words: str) -> None:
        """Hear why only a new start of the daemon gives the camera back; ``""`` says that it is not so."""
        self._cycle.note_lost_camera(words)
