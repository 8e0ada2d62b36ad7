"""Wall-clock times of a newcomer's commands: set-up with demo, and all checks and tests, in a new clone."""

import os
import subprocess
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.timing import Measurement

ROOT = Path(__file__).parents[1]


def measure(root: Path = ROOT) -> list[Measurement]:
    """Clone the committed state of a repository, and time `make demo` and `make test` with an empty cache."""
    with TemporaryDirectory() as folder:
        clone = Path(folder, "clone")
        subprocess.run(["git", "clone", "--quiet", str(root), str(clone)], check=True)
        demo_s, test_s = (_time_make(task, clone, Path(folder, "cache")) for task in ("demo", "test"))
    return [
        Measurement("make demo in a new clone, with its set-up (wall s)", [demo_s], limit=90.0),
        Measurement("make test after it (wall s)", [test_s], limit=300.0),
        # as continuous integration, which is not scaled: the limit is for its own machine
        Measurement("make demo and make test on this machine (min)", [(demo_s + test_s) / 60.0], limit=12.0),
    ]


def _time_make(task: str, folder: Path, cache: Path) -> float:
    """Return the wall-clock time of a task; raises RuntimeError with its last lines if it fails."""
    # of the caller's environment and of a `make` that started this program
    inherited = ("PYTHONPATH", "VIRTUAL_ENV", "MAKEFLAGS", "MAKELEVEL", "MFLAGS")
    environment = {name: value for name, value in os.environ.items() if name not in inherited}
    start = time.perf_counter()
    result = subprocess.run(
        ["make", task], cwd=folder, env=environment | {"MARSYARD_CACHE": str(cache)}, capture_output=True, text=True
    )
    if result.returncode:
        raise RuntimeError(f"make {task} ended with {result.returncode}: {(result.stdout + result.stderr)[-2000:]}")
    return time.perf_counter() - start
