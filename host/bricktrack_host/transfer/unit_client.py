"""Speaks to one brick unit: a method for each request."""

import threading
import time
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Self

import zmq

from bricktrack_common.checksums import crc32
from bricktrack_common.errors import ProtocolError, TransferError, UnitTimeoutError
from bricktrack_common.key_files import KeyPair
from bricktrack_common.wire_messages import (
    Arm,
    Armed,
    Configure,
    Configured,
    ConfigValue,
    Confirm,
    Confirmed,
    Deleted,
    DeleteRun,
    DescribeRun,
    Disarm,
    Disarmed,
    GetStatus,
    Hello,
    HelloReply,
    ListRuns,
    RunDescription,
    RunList,
    StatusReply,
    StillEncoding,
    StillImage,
    TakeStill,
)
from bricktrack_host.transfer.chunk_reads import CREDIT, VerifiedChunk, read_chunks
from bricktrack_host.transfer.unit_connection import ClientCounts, UnitConnection

_LOOKS_WHILE_SILENT = 4  # how often a unit that works on something is asked for a sign of life


class UnitClient:
    """A connection to one unit. Not to be shared between threads; the context may be.

    Parameters
    ----------
    address : str
        ``tcp://host:port``.
    timeout_s : float, s
        How long a unit may be silent before `UnitTimeoutError` is raised.
    context : zmq.Context, optional
        Default: the process's own.
    stop : threading.Event, optional
        Once it is set, waiting ends with `Stopped`.
    server_key : str
        The unit's public key; nothing else is spoken to then, whatever answers at the address. Without it
        nothing is encrypted, and a unit that has keys does not answer.
    own_keys : KeyPair, optional
        This host's; must be given with ``server_key``.

    Raises
    ------
    UnitError
        If the address is none.
    ConfigError
        If a key is none, or this host's is missing.
    """

    def __init__(
        self,
        address: str,
        *,
        timeout_s: float = 5.0,
        context: zmq.Context[zmq.Socket[bytes]] | None = None,
        stop: threading.Event | None = None,
        server_key: str = "",
        own_keys: KeyPair | None = None,
    ) -> None:
        self.address = address
        self.timeout_s = timeout_s
        self._connection = UnitConnection(
            address,
            timeout_s=timeout_s,
            context=context,
            stop=stop,
            server_key=server_key,
            own_keys=own_keys,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def counts(self) -> ClientCounts:
        """What came that was not waited for."""
        return self._connection.counts

    def close(self) -> None:
        """End the connection; requests under way are forgotten."""
        self._connection.close()

    def hello(self, software: str = "bricktrack") -> HelloReply:
        """Ask who is there."""
        return self._connection.ask(Hello(software=software), HelloReply)

    def status(self) -> StatusReply:
        """Ask how the unit is."""
        return self._connection.ask(GetStatus(), StatusReply)

    def arm(self, label: str = "", *, duration_s: float | None = None, patience_s: float = 60.0) -> Armed:
        """Make the unit ready for the next first edge; returns once it *is* ready.

        A camera may take longer to start than a unit may be silent: meanwhile the unit is asked how it is,
        and waited for while it answers.

        Raises
        ------
        UnitTimeoutError
            If nothing comes for ``timeout_s``, or the unit is not ready after ``patience_s``.
        """
        now_s = time.monotonic()
        give_up_s = now_s + patience_s
        silent_s = now_s + self.timeout_s
        arming = self._connection.send(Arm(label=label, duration_s=duration_s), silent_s)
        while (now_s := time.monotonic()) < give_up_s:
            look_s = now_s + self.timeout_s / _LOOKS_WHILE_SILENT
            try:
                reply_id, reply, _ = self._connection.receive(min(look_s, silent_s), "arm")
            except UnitTimeoutError:
                if time.monotonic() >= silent_s:
                    raise
                self._connection.send(GetStatus(), silent_s)
                continue
            if reply_id == arming:
                return self._connection.expect(reply, Armed, "arm")
            silent_s = time.monotonic() + self.timeout_s
            self.counts.stray_replies += not isinstance(reply, StatusReply)
        raise UnitTimeoutError(
            f"{self.address}: answers, but is not ready to record after {patience_s:g} s. "
            "'bricktrack status' shows what it does, 'bricktrack disarm' brings it back"
        )

    def disarm(self, *, timeout_s: float = 30.0) -> Disarmed:
        """Bring the unit back to idle without a run."""
        return self._connection.ask(Disarm(), Disarmed, timeout_s=timeout_s)

    def list_runs(self) -> RunList:
        """Return the runs on the unit, oldest first."""
        return self._connection.ask(ListRuns(), RunList)

    def describe_run(self, run_id: str, *, timeout_s: float = 30.0) -> RunDescription:
        """Return one run's files; the unit may have to hash them first."""
        reply = self._connection.ask(DescribeRun(run_id=run_id), RunDescription, timeout_s=timeout_s)
        if reply.run_id != run_id:
            raise ProtocolError(f"{self.address}: described run {reply.run_id}; asked for {run_id}")
        return reply

    def confirm(self, run_id: str, sha256: list[str], *, timeout_s: float | None = None) -> Confirmed:
        """Tell the unit that these files, in the order of its description, are verified and on disk here.

        Told other hashes than it has described, a unit reads its files again, which takes a while; where its
        card has altered one it describes the run anew. Either way it refuses them.
        """
        return self._connection.ask(Confirm(run_id=run_id, sha256=sha256), Confirmed, timeout_s=timeout_s)

    def delete_run(self, run_id: str, *, force: bool = False, timeout_s: float = 30.0) -> Deleted:
        """Remove a run from the unit: one that a host has confirmed, or any with ``force``."""
        return self._connection.ask(DeleteRun(run_id=run_id, force=force), Deleted, timeout_s=timeout_s)

    def configure(
        self, values: Mapping[str, ConfigValue] | None = None, *, timeout_s: float = 30.0
    ) -> Configured:
        """Change values of the unit's configuration, for good; without any, only ask what they are.

        Parameters
        ----------
        values : mapping
            By dotted key, ``{"camera.exposure_us": 2000}``; `None` goes back to what the unit's file says.
        """
        return self._connection.ask(Configure(values=dict(values or {})), Configured, timeout_s=timeout_s)

    def still(
        self, *, encoding: StillEncoding = "png", lit: bool = True, timeout_s: float = 45.0
    ) -> tuple[StillImage, bytes]:
        """Return a picture of now: what is said of it, and the bytes of a PNG or JPEG file.

        The unit must be idle; starting its camera takes seconds. A PNG is grey: the camera's own luma, 16
        for black and 235 for white. With ``lit`` the LEDs are lit, where they hang on the unit's pins.

        Raises
        ------
        TransferError
            If the picture does not match its checksum.
        """
        reply, data = self._connection.ask_with_data(
            TakeStill(encoding=encoding, lit=lit), StillImage, timeout_s=timeout_s
        )
        if len(data) != reply.n_bytes or crc32(data) != reply.crc32:
            raise TransferError(
                f"{self.address}: the picture came broken ({len(data)} of {reply.n_bytes} bytes); ask again"
            )
        return reply, data

    def read_chunks(
        self, run_id: str, file_index: int, ranges: list[tuple[int, int]], *, credit: int = CREDIT
    ) -> Iterator[VerifiedChunk]:
        """Yield the bytes of some ranges of a file: see `chunk_reads.read_chunks`."""
        return read_chunks(self._connection, run_id, file_index, ranges, credit=credit)
