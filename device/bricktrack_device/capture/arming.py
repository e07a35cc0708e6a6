"""What comes before a run's sensors start: what a killed daemon left, room on the card, a name."""

from collections.abc import Callable
from functools import partial

from bricktrack_common.clocks import check_monotonic_is_boottime, read_clock_triplet
from bricktrack_device.capture.black_box import BlackBox
from bricktrack_device.capture.retention import make_room
from bricktrack_device.capture.room import check_room
from bricktrack_device.capture.run_light import RunLight
from bricktrack_device.capture.session import Session
from bricktrack_device.config import DeviceConfig
from bricktrack_device.in_time import in_time
from bricktrack_device.interfaces import Rig
from bricktrack_device.storage.run_store import RunStore

_BRING_IN_TIMEOUT_S = 60.0


def new_session(
    config: DeviceConfig,
    rig: Rig,
    store: RunStore,
    black_box: BlackBox,
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
    bring_in = partial(black_box.bring_in, store)
    in_time("bringing a run in", bring_in, _BRING_IN_TIMEOUT_S, beat=beat)
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
