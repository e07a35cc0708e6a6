"""What the page shows of one unit: its state as one word, what is wrong with it, and what mends that."""

from dataclasses import dataclass

from bricktrack_common.errors import BricktrackError
from bricktrack_common.wire_messages import StatusReply
from bricktrack_host.campaign.readiness import obstacles


@dataclass(frozen=True, slots=True)
class StateLook:
    """How a state is drawn: also told apart without colours, by its letter."""

    letter: str
    fill: str
    ink: str
    meaning: str


STATES: dict[str, StateLook] = {
    "idle": StateLook("I", "#56b4e9", "#06283d", "ready to be armed"),
    "not ready": StateLook("!", "#cc79a7", "#2b0a1c", "idle, but a check fails"),
    "armed": StateLook("A", "#f0e442", "#332f00", "waits for the first edge"),
    "recording": StateLook("R", "#d55e00", "#ffffff", "records now"),
    "saving": StateLook("S", "#009e73", "#ffffff", "writes its run to the card"),
    "fault": StateLook("F", "#1b1b1b", "#ffffff", "stopped by an error"),
    "no answer": StateLook("?", "#ffffff", "#1b1b1b", "does not answer"),
    "asking": StateLook("…", "#d9dce1", "#3c4148", "was not heard of yet"),
}
"""Okabe and Ito's colours, which people with any kind of colour vision tell apart."""


@dataclass(frozen=True, slots=True)
class UnitView:
    """One unit, as the page shows it.

    Attributes
    ----------
    state : str
        A key of `STATES`.
    problems : tuple of (str, str)
        What keeps it from recording, each with its remedy.
    warnings : tuple of (str, str)
        What makes runs worse, each with its remedy.
    """

    name: str
    state: str = "asking"
    run_id: str = ""
    n_runs: int | None = None
    n_to_pull: int | None = None
    free_gb: float | None = None
    temperature_degc: float | None = None
    simulated: bool = False
    problems: tuple[tuple[str, str], ...] = ()
    warnings: tuple[tuple[str, str], ...] = ()

    @property
    def note(self) -> str:
        """The worst that is to be said of it, in one line."""
        told = self.problems or self.warnings
        return told[0][0] if told else ""


def view_of(name: str, answer: StatusReply | BricktrackError, *, simulated: bool = False) -> UnitView:
    """Return what a unit's answer, or its silence, amounts to."""
    if isinstance(answer, BricktrackError):
        words, _, remedy = str(answer).partition(". ")
        return UnitView(name, "no answer", problems=((words, remedy),))
    at_work = f"{answer.state} for"  # an obstacle to another run, but no fault of the unit
    problems = [(words, remedy) for words, remedy in obstacles(answer) if not words.startswith(at_work)]
    state = "not ready" if answer.state == "idle" and problems else answer.state
    warnings = [(f"{h.name}: {h.words}", h.remedy) for h in answer.health if h.level == "warn"]
    if answer.last_error and answer.state != "fault":
        warnings.append((answer.last_error, ""))
    return UnitView(
        name,
        state,
        run_id=answer.run_id,
        n_runs=answer.runs,
        n_to_pull=answer.runs_unconfirmed,
        free_gb=round(answer.disk_free_bytes / 1e9, 1),
        temperature_degc=None if answer.temperature_degc is None else round(answer.temperature_degc),
        simulated=simulated,
        problems=tuple(problems),
        warnings=tuple(warnings),
    )
