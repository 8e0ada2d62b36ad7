"""Progress reports while the first cases on a machine compile numeric kernels."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from marsyard.scenarios.systems import scenario_paths
from marsyard.sim.kernel_cache import count_compiled_functions, kernels_are_ready

#: Seconds between two reports.
REPORT_INTERVAL_S = 10.0


@contextmanager
def compilation_reported(scenario: str, note: Callable[[str], None]) -> Iterator[Callable[[], None]]:
    """Report the compilation of kernels until the context ends; nothing where they are compiled already.

    Yields a function to be called when the first case has ended and compilation is complete.
    """
    if scenario not in scenario_paths() or kernels_are_ready(scenario):
        yield lambda: None
        return
    note("compiling numeric kernels once on this machine, about two minutes (ahead of time: marsyard compile)")
    ended, began, before = threading.Event(), time.monotonic(), count_compiled_functions()

    def report() -> None:
        while not ended.wait(REPORT_INTERVAL_S):
            number = count_compiled_functions() - before
            note(f"compiling numeric kernels: {number} functions so far, {time.monotonic() - began:.0f} s")

    def finish() -> None:
        if not ended.is_set():
            ended.set()
            note(f"numeric kernels are compiled, {time.monotonic() - began:.0f} s")

    thread = threading.Thread(target=report, daemon=True)
    thread.start()
    try:
        yield finish
    finally:
        ended.set()
        thread.join()
