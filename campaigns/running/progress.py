"""Progress reports of a campaign or study: the interface of the objects that receive them."""

from typing import Protocol


class ProgressObserver(Protocol):
    """Receiver of progress reports of a campaign."""

    def begin(self, stage: str, total: int) -> None:
        """Start a stage with a number of steps."""

    def step(self) -> None:
        """Count a finished step of the stage."""

    def note(self, text: str) -> None:
        """Report a text to the user; may be called from another thread."""
