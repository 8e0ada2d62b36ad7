"""Device of a worker process, such as an accelerator."""

import os
from collections.abc import Sequence

#: Environment variable: number of a worker process, counted from 0.
WORKER_NUMBER = "MARSYARD_WORKER_NUMBER"


def worker_device(devices: Sequence[str]) -> str:
    """Return the device of this worker process; the workers receive the devices in turn."""
    return devices[int(os.environ.get(WORKER_NUMBER, "0")) % len(devices)]
