"""Whether the products of cases contain their timelines (`marsyard.scenarios.timeline`)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_is_recording_timelines: ContextVar[bool] = ContextVar("_is_recording_timelines", default=False)


@contextmanager
def recording_timelines(is_recording: bool = True) -> Iterator[None]:
    """Add timelines to the products of cases that run while the context is active, or do not."""
    token = _is_recording_timelines.set(is_recording)
    try:
        yield
    finally:
        _is_recording_timelines.reset(token)


def is_recording_timelines() -> bool:
    """Return whether the products of the running case contain its timeline (`marsyard.scenarios.timeline`)."""
    return _is_recording_timelines.get()
