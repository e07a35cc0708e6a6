"""What a pull tells while it is under way, so that someone can show it."""

import logging
from typing import Protocol

logger = logging.getLogger(__name__)


class PullProgress(Protocol):
    """Hears how a pull goes; called from several threads."""

    def unit_listed(self, unit: str, n_runs: int, n_bytes: int) -> None:
        """Hear how much a unit has that is not here yet."""
        ...

    def unit_started(self, unit: str) -> None:
        """Hear that a unit has its turn."""
        ...

    def bytes_done(self, unit: str, n_bytes: int) -> None:
        """Hear that this many more bytes of it are verified here; negative if some must come again."""
        ...

    def unit_done(self, unit: str) -> None:
        """Hear that nothing more comes from a unit."""
        ...

    def note(self, unit: str, text: str) -> None:
        """Hear of something that a person would want to know."""
        ...


class QuietProgress:
    """Logs the notes and shows nothing."""

    def unit_started(self, unit: str) -> None:
        """Show nothing."""

    def unit_listed(self, unit: str, n_runs: int, n_bytes: int) -> None:
        """Log what is to be done."""
        logger.info("%s: %d runs, %d bytes to fetch", unit, n_runs, n_bytes)

    def bytes_done(self, unit: str, n_bytes: int) -> None:
        """Show nothing."""

    def unit_done(self, unit: str) -> None:
        """Show nothing."""

    def note(self, unit: str, text: str) -> None:
        """Log the note."""
        logger.warning("%s: %s", unit, text)
