"""Run times of starting the command line, of compiling kernels after installation, and of the first campaign."""

import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.timing import Measurement


def measure(repeats: int) -> list[Measurement]:
    """Measure the wall-clock times of starting the command, of compiling kernels and of the first run."""
    return [
        Measurement("marsyard --help (wall s)", [_measure_wall_s("--help") for _ in range(repeats)], limit=0.3),
        Measurement("marsyard list (wall s)", [_measure_wall_s("list") for _ in range(repeats)], limit=0.6),
        *_measure_first_run(),
    ]


def _measure_first_run() -> list[Measurement]:
    """Measure the compilation of kernels, and the additional time of a first campaign compared with a repetition."""
    with TemporaryDirectory() as folder:
        compile_s = _measure_wall_s("compile", variables={"MARSYARD_CACHE": folder})

        def run(name: str) -> float:
            arguments = ("run", "dimes-smoke", "-n", "1", "--jobs", "1", "--set", "retain.showcase=none")
            variables = {"MARSYARD_CACHE": folder}
            # status 3: one case is too few for a verdict
            return _measure_wall_s(*arguments, "--out", str(Path(folder, name)), variables=variables, allowed=(0, 3))

        first_s = run("first")
        repetition_s = min(run(f"again {number}") for number in range(2))
    return [
        Measurement("marsyard compile after installation (wall s)", [compile_s]),
        Measurement("first run: additional time for loading kernels (wall s)", [first_s - repetition_s], limit=3.0),
    ]


def _measure_wall_s(*arguments: str, variables: dict[str, str] | None = None, allowed: tuple[int, ...] = (0,)) -> float:
    """Measure the wall-clock time of a `marsyard` command, seconds; `allowed` are its accepted exit statuses."""
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"} | (variables or {})
    start = time.perf_counter()
    result = subprocess.run(
        [sys.executable, "-m", "marsyard", *arguments], env=environment, capture_output=True, text=True
    )
    elapsed_s = time.perf_counter() - start
    if result.returncode not in allowed:
        raise RuntimeError(f"marsyard {' '.join(arguments)} ended with {result.returncode}: {result.stderr}")
    return elapsed_s
