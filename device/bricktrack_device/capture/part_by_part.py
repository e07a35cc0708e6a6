"""A bug in one part of a run costs that part alone."""

import logging
from collections.abc import Callable
from typing import TypeVar

from bricktrack_common.errors import StorageError

logger = logging.getLogger(__name__)

T = TypeVar("T")


def unless_a_bug(what: str, make: Callable[[], T], otherwise: T, *, note: Callable[[str], bool]) -> T:
    """Return what ``make`` does, or ``otherwise`` where it fails by anything but the card.

    Parameters
    ----------
    what : str
        Names the part in words.
    note : callable
        Notes the words of a bug in the run, and tells whether they are new.

    Raises
    ------
    StorageError
        Of ``make``: the part itself is well, and can be tried again.
    """
    try:
        return make()
    except StorageError:
        raise
    except Exception as e:
        if note(f"{what}: internal error: {type(e).__name__}: {e}"):
            logger.exception("%s: a bug; the run goes on without", what)
        return otherwise
