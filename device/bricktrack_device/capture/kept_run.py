"""A recording from the moment it was made until it is on the card: nothing in between may lose it."""

from bricktrack_common.errors import StorageError
from bricktrack_device.capture.black_box import BlackBox
from bricktrack_device.capture.recording import Recording
from bricktrack_device.capture.saving import save
from bricktrack_device.interfaces import Rig
from bricktrack_device.storage.run_store import RunStore
from bricktrack_device.storage.run_writer import RunWriter

_ROOM_BYTES = 1 << 20
"""Beside a run, before saving it is tried again on a card that was full."""


class KeptRun:
    """At most one recording in memory, and the writer that goes on where it failed before.

    Parameters
    ----------
    store : RunStore
    rig : Rig
        Knows the true motion of simulated runs.
    black_box : BlackBox
        Holds a copy until the run is on the card.
    """

    def __init__(self, store: RunStore, rig: Rig, black_box: BlackBox) -> None:
        self._store = store
        self._rig = rig
        self._black_box = black_box
        self._kept: tuple[Recording, RunWriter] | None = None

    @property
    def run_id(self) -> str:
        """Which run is not on the card yet; ``""`` if there is none."""
        return "" if self._kept is None else self._kept[0].run_id

    def keep(self, recording: Recording) -> None:
        """Hold a recording until it is saved."""
        self._kept = recording, self._store.open_writer(recording.run_id)
        self._black_box.take(lambda: recording)

    @property
    def fate(self) -> str:
        """What becomes of the run where the daemon ends before it is saved, in words."""
        if self.run_id == self._black_box.run_id:
            return "not on the card; a copy in memory waits for the next start"
        return "lost from memory; its folder holds what was saved"

    def has_room(self) -> bool:
        """Tell whether saving it is worth another try; a card that does not say how full it is has none."""
        if self._kept is None:
            return False
        try:
            return self._store.free_bytes() > self._kept[0].n_bytes + _ROOM_BYTES
        except StorageError:
            return False

    def save(self) -> Recording:
        """Put the recording on the card, and hold it no longer.

        Raises
        ------
        StorageError
            If the card does not take it: it is still held, and so is what was written of it.
        """
        if self._kept is None:
            raise StorageError("there is no run to save")
        recording, writer = self._kept
        start_ns, end_ns = recording.truth_window_ns
        save(
            recording,
            writer,
            lambda folder: self._rig.write_truth(folder, start_ns=start_ns, end_ns=end_ns),
        )
        self._kept = None
        self._black_box.forget()
        return recording
