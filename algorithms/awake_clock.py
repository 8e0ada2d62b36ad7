"""Clock that does not count the time during which this process is suspended."""

import time

#: Maximum time between two readings of an `AwakeClock` that is counted, s.
_MAX_STEP_S = 1.0


class AwakeClock:
    """Clock that counts only the time during which this process reads it at least once a second.

    If this process is suspended, together with the process that it monitors, the time of the suspension is not counted.
    """

    def __init__(self) -> None:
        self._elapsed_s, self._last_s = 0.0, time.monotonic()

    def elapsed_s(self) -> float:
        """Return the counted time since the creation of the clock."""
        now_s = time.monotonic()
        self._elapsed_s += min(now_s - self._last_s, _MAX_STEP_S)
        self._last_s = now_s
        return self._elapsed_s
