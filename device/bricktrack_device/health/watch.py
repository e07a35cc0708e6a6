"""The cheap part of the check, looked at now and then by the daemon, for its status.

While the unit is armed, records or saves nothing is looked at: the status then says how old the findings are.
"""

import logging
import time
from collections.abc import Callable, Iterable, Sequence

from bricktrack_common.wire_messages import DaemonState, HealthItem
from bricktrack_device.config import DeviceConfig
from bricktrack_device.health import machine, storage
from bricktrack_device.health.findings import CheckResult, tried, warning
from bricktrack_device.health.inertial import check_adapter
from bricktrack_device.health.self_test import run_self_test
from bricktrack_device.interfaces import Rig

logger = logging.getLogger(__name__)

PERIOD_S = 30.0
_QUIET_STATES: tuple[DaemonState, ...] = ("idle", "fault")


class HealthWatch:
    """Findings of the cheap checks, kept fresh by `refresh_if_due`.

    Parameters
    ----------
    config : DeviceConfig
    rig : Rig
    period_s : float
    clock : callable
        Seconds, monotonic.
    """

    def __init__(
        self,
        config: DeviceConfig,
        rig: Rig,
        *,
        period_s: float = PERIOD_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._config = config
        self._rig = rig
        self._period_s = period_s
        self._clock = clock
        # What cannot change while the daemon runs is looked at once.
        self._lasting: list[CheckResult] | None = None
        self._found: tuple[float, list[CheckResult]] | None = None
        self._self_test: list[CheckResult] = []

    def test_hardware(self, is_over: Callable[[], bool]) -> None:
        """Try the hardware once, before the unit is ready; see `run_self_test`."""
        self._self_test = run_self_test(self._config, self._rig, is_over=is_over)
        _tell(self._self_test)

    def configure(self, config: DeviceConfig) -> None:
        """Look by another configuration from the next time on."""
        self._config = config

    def refresh_if_due(self, state: DaemonState) -> bool:
        """Look again if it is time and the unit has nothing better to do; tell whether it did."""
        now = self._clock()
        if state not in _QUIET_STATES:
            return False
        if self._found is not None and now - self._found[0] < self._period_s:
            return False
        before = {} if self._found is None else {r.name: r.level for r in self._found[1]}
        try:
            results = self._look()
        except Exception as e:
            # The daemon's own thread calls this, and a run may begin meanwhile: it must go on.
            logger.exception("a bug in the health checks")
            words = f"internal error: {type(e).__name__}: {e}"
            results = [warning("health", words, "Report it, with the daemon's log")]
        self._found = now, results
        _tell(r for r in results if before.get(r.name) != r.level)
        return True

    @property
    def items(self) -> Sequence[HealthItem]:
        """The newest findings and the self-test's. Safe from any thread."""
        found = self._found
        return [r.as_item() for r in (*(found[1] if found else ()), *self._self_test)]

    @property
    def age_s(self) -> float | None:
        """How old they are, s."""
        found = self._found
        return None if found is None else max(0.0, self._clock() - found[0])

    def _look(self) -> list[CheckResult]:
        if self._lasting is None:
            self._lasting = self._look_once()
        results = tried("clocks", "Reboot the unit and disable suspend", machine.check_clocks)
        results += tried("storage", "Set storage.folder", lambda: storage.check_space(self._config))
        results += tried("black box", "Set storage.black_box", lambda: storage.check_black_box(self._config))
        results += machine.check_temperature()
        results += machine.check_throttling(machine.read_throttled())
        return results + self._lasting

    def _look_once(self) -> list[CheckResult]:
        results = machine.check_realtime(self._config.sampler)
        if not self._rig.simulated:
            results += machine.check_permissions([imu.bus for imu in self._config.imu])
            for imu in self._config.imu:
                self._rig.bus_opener(imu.bus)
            described = self._rig.describe()
            for imu in self._config.imu:
                results += check_adapter(imu, described, simulated=False)
        return results


def _tell(results: Iterable[CheckResult]) -> None:
    for r in results:
        if r.level != "ok":
            logger.warning("health: %s: %s. %s", r.name, r.detail, r.remedy)
