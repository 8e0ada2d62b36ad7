"""Start-up times: the command line, and compilation of kernels after installation."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.timing import Measurement


def measure(repeats: int) -> list[Measurement]:
    """Wall-clock times of starting the command, of compiling kernels and of the first run."""
    return [
        Measurement("marsyard --help (wall s)", [_wall_s("--help") for _ in range(repeats)], limit=0.3),
        Measurement("marsyard list (wall s)", [_wall_s("list") for _ in range(repeats)], limit=0.6),
        *_first_use(),
    ]


def _first_use() -> list[Measurement]:
    """Time to compile kernels, and additional time of the first campaigns compared with a repetition.

    The very first campaign also builds its terrains.
    """
    with TemporaryDirectory() as folder:
        new, built = Path(folder, "new"), Path(folder, "built")
        ahead = _wall_s("compile", more=_caching(new))
        shutil.copytree(new, built)

        def run(cache: Path, name: str) -> float:
            words = ("run", "dimes-smoke", "-n", "1", "--jobs", "1", "--set", "retain.showcase=none")
            return _wall_s(*words, "--out", str(Path(folder, name)), more=_caching(cache), allowed=(0, 3))

        first = run(new, "first")
        shutil.copytree(new / "terrain", built / "terrain", dirs_exist_ok=True)
        with_terrains = run(built, "with terrains")
        again = min(run(built, f"again {number}") for number in range(2))
    return [
        Measurement("marsyard compile on a fresh installation, part of its set-up (wall s)", [ahead]),
        Measurement("additional time of the first run for kernels (wall s)", [with_terrains - again], limit=3.0),
        Measurement("the same with the eight terrains that it builds (wall s)", [first - again]),
    ]


def _caching(folder: Path) -> dict[str, str]:
    return {"MARSYARD_CACHE": str(folder)}


def _wall_s(*words: str, more: dict[str, str] | None = None, allowed: tuple[int, ...] = (0,)) -> float:
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"} | (more or {})
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-m", "marsyard", *words], env=environment, capture_output=True, text=True)
    elapsed_s = time.perf_counter() - start
    if done.returncode not in allowed:
        raise RuntimeError(f"marsyard {' '.join(words)} ended with {done.returncode}: {done.stderr}")
    return elapsed_s
