"""Reaching a unit, and making sure that it is the one that is meant: by its name, never by its address."""

import logging
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

from bricktrack_common.errors import BricktrackError, ConfigError, UnitError, UnitTimeoutError
from bricktrack_common.key_files import KeyPair
from bricktrack_common.wire_messages import HelloReply
from bricktrack_host.transfer.fleet_config import UnitConfig, check_name, is_loopback
from bricktrack_host.transfer.unit_client import UnitClient

logger = logging.getLogger(__name__)

MAX_ASKED_AT_ONCE = 128
"""Units that are asked side by side; each takes a thread and two file handles meanwhile."""

T = TypeVar("T")


class Finder(Protocol):
    """Knows where units are now."""

    def find(self, unit: UnitConfig) -> str | None:
        """Return a unit's address as ``tcp://host:port``, or `None` where nobody answers to its name."""
        ...


@dataclass(frozen=True, slots=True)
class Contact:
    """A connection to the unit that was meant."""

    unit: UnitConfig
    client: UnitClient
    hello: HelloReply


@dataclass(frozen=True, slots=True)
class Dialer:
    """How this host reaches its units.

    Attributes
    ----------
    timeout_s : float, s
        How long a unit may be silent.
    finder : Finder, optional
        Where to look for a unit without an address, and for one that is not at its address.
    own_keys : KeyPair, optional
        This host's, for units that have keys.
    stop : threading.Event, optional
        Once it is set, waiting for a unit ends with `unit_connection.Stopped`.
    """

    timeout_s: float = 5.0
    finder: Finder | None = None
    own_keys: KeyPair | None = None
    stop: threading.Event | None = None

    @contextmanager
    def reach(self, unit: UnitConfig) -> Iterator[Contact]:
        """Connect to a unit and check who it is.

        Raises
        ------
        UnitTimeoutError
            If it does not answer at its address, nor where the finder sees it.
        ConfigError
            If another unit answers, or nobody knows where it is.
        """
        with ExitStack() as opened:
            try:
                contact = self._try(unit, unit.address, opened) if unit.address else None
            except (UnitTimeoutError, ConfigError, UnitError) as e:
                # Nobody is there, or another unit: addresses that are handed out go round.
                moved = None if isinstance(e, UnitError) and e.code != "not-allowed" else self._find(unit)
                if moved is None or moved == unit.address:
                    raise
                logger.warning("%s: not at %s any more; found at %s", unit.name, unit.address, moved)
                contact = self._try(unit, moved, opened)
            if contact is None:
                contact = self._try(unit, self._find_or_fail(unit), opened)
            yield contact

    @contextmanager
    def client(self, unit: UnitConfig) -> Iterator[UnitClient]:
        """Connect to a unit, check who it is, and yield the client alone."""
        with self.reach(unit) as contact:
            yield contact.client

    def _try(self, unit: UnitConfig, address: str, opened: ExitStack) -> Contact:
        with ExitStack() as mine:
            client = mine.enter_context(
                UnitClient(
                    address,
                    timeout_s=self.timeout_s,
                    stop=self.stop,
                    server_key=unit.server_key,
                    own_keys=self.own_keys if unit.server_key else None,
                )
            )
            hello = client.hello()
            check_name(hello, unit, address)
            opened.push(mine.pop_all())
        return Contact(unit, client, hello)

    def _find(self, unit: UnitConfig) -> str | None:
        """Ask the finder; a unit that cannot prove who it is, is followed on this machine only."""
        found = self.finder.find(unit) if self.finder is not None else None
        if found is None or unit.server_key or is_loopback(found):
            return found
        logger.warning(
            "%s: something at %s uses this name; without server_key in the fleet file it is not believed",
            unit.name, found,
        )  # fmt: skip
        return None

    def _find_or_fail(self, unit: UnitConfig) -> str:
        found = self._find(unit)
        if found is None:
            raise ConfigError(
                f"unit {unit.name} has no address in the fleet file and was not found by its name. Is it on "
                "and in this network? 'bricktrack find' shows who is; one with an address needs no finding"
            )
        return found


def ask_units(
    units: list[UnitConfig],
    question: Callable[[Contact], T],
    *,
    dialer: Dialer,
    told: Callable[[UnitConfig, T | BricktrackError], None] | None = None,
) -> list[T | BricktrackError]:
    """Ask many units at once; return each one's answer, or the error it gave, in the order of ``units``.

    Parameters
    ----------
    question : callable
        Called in a thread of its own for each unit, with a `Contact`.
    dialer : Dialer
    told : callable, optional
        Hears each answer when it comes; called from several threads.
    """
    stop = dialer.stop or threading.Event()
    with_stop = replace(dialer, stop=stop)

    def ask(unit: UnitConfig) -> T | BricktrackError:
        answer: T | BricktrackError
        try:
            with with_stop.reach(unit) as contact:
                answer = question(contact)
        except BricktrackError as e:
            answer = e
        if told is not None:
            told(unit, answer)
        return answer

    with ThreadPoolExecutor(max(1, min(MAX_ASKED_AT_ONCE, len(units))), "ask") as pool:
        answers = pool.map(ask, units)
        try:
            return list(answers)
        except BaseException:
            stop.set()  # Ctrl-C does not wait for a unit that is slow to answer
            raise
