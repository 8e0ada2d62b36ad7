"""How long a user waits before anything happens: the command's start, and kernels on a fresh installation."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.timing import Figure


def figures(repeats: int) -> list[Figure]:
    """The start of the command, in wall-clock seconds of whole processes; kernels compiled ahead, and the first run."""
    return [
        Figure("marsyard --help (wall s)", [_wall_s("--help") for _ in range(repeats)], bar=0.3),
        Figure("marsyard list (wall s)", [_wall_s("list") for _ in range(repeats)], bar=0.6),
        *_first_use(),
    ]


def _first_use() -> list[Figure]:
    """What set-up compiles, and what the first campaign after it still waits for beside the same campaign again."""
    with TemporaryDirectory() as folder:
        there = {"MARSYARD_CACHE": str(Path(folder, "cache"))}
        ahead = _wall_s("compile", more=there)
        run = ("run", "dimes-smoke", "-n", "1", "--jobs", "1", "--set", "retain.showcase=none", "--out")
        # the terrain is made by the first of three runs; kernels are there from the start
        waits = [_wall_s(*run, str(Path(folder, str(number))), more=there, allowed=(0, 3)) for number in range(3)]
    return [
        Figure("marsyard compile on a fresh installation, part of its set-up (wall s)", [ahead]),
        Figure(
            "the first run's wait for kernels and terrain over the third's (wall s)", [waits[0] - waits[2]], bar=3.0
        ),
    ]


def _wall_s(*words: str, more: dict[str, str] | None = None, allowed: tuple[int, ...] = (0,)) -> float:
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"} | (more or {})
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-m", "marsyard", *words], env=environment, capture_output=True, text=True)
    taken = time.perf_counter() - start
    if done.returncode not in allowed:
        raise RuntimeError(f"marsyard {' '.join(words)} ended with {done.returncode}: {done.stderr}")
    return taken
