"""What comes before a run's sensors start: what a killed daemon left, room on the card, a name."""

from collections.abc import Callable

from bricktrack_common.clocks import check_monotonic_is_boottime, read_clock_triplet
from bricktrack_device.capture.black_box import BlackBox
from bricktrack_device.capture.retention import make_room
from bricktrack_device.capture.room import check_room
from bricktrack_device.capture.run_light import RunLight
from bricktrack_device.capture.session import Session
from bricktrack_device.config import DeviceConfig
from bricktrack_device.in_time import ThreadedCall, result_in_time
from bricktrack_device.interfaces import Rig
from bricktrack_device.storage.run_store import RunStore

_BRING_IN_TIMEOUT_S = 60.0


class BringIn:
    """Puts on the card what a killed daemon left, in a thread of its own; never in two at a time.

    One that hangs with the card may go on later: had the unit armed meanwhile, it would meet a run that is
    being saved, and take it for one that was cut off.

    Parameters
    ----------
    black_box : BlackBox
    store : RunStore
    """

    def __init__(self, black_box: BlackBox, store: RunStore) -> None:
        self._black_box = black_box
        self._store = store
        self._call: ThreadedCall[None] | None = None

    def in_time(self, *, beat: Callable[[], None]) -> None:
        """Bring in what there is, or wait for the one that hung before.

        Raises
        ------
        HangsError
            If it does not return in time.
        """
        if self._call is None or self._call.has_ended(within_s=0.0):
            self._call = ThreadedCall(lambda: self._black_box.bring_in(self._store), name="bring-in")
        result_in_time("bringing a run in", self._call, _BRING_IN_TIMEOUT_S, beat=beat)


def new_session(
    config: DeviceConfig,
    rig: Rig,
    store: RunStore,
    bring_in: BringIn,
    *,
    label: str,
    duration_s: float,
    light: RunLight,
    beat: Callable[[], None],
) -> Session:
    """Return the sensors of a run that there is room for, not yet opened; its id is taken from now on.

    Raises
    ------
    BricktrackError
        If the unit was suspended, there is no room, or the card fails.
    """
    check_monotonic_is_boottime(read_clock_triplet())
    # Where the card was full when the daemon began; a slow one takes its time.
    bring_in.in_time(beat=beat)
    make_room(config, store, duration_s)
    check_room(config, store, duration_s)
    return Session(
        config,
        rig,
        run_id=store.new_run_id(label),
        label=label,
        duration_s=duration_s,
        light=light,
        beat=beat,
    )
