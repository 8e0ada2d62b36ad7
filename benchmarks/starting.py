"""How long a user waits before anything happens: the command's start, and kernels on a fresh installation."""

from __future__ import annotations

import os
import shutil
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
    """What set-up compiles, and what the first campaigns after it still wait for beside the same campaign again.

    The first of all builds its terrains; the first with terrains that are there waits for kernels alone.
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
        Figure("marsyard compile on a fresh installation, part of its set-up (wall s)", [ahead]),
        Figure("the first run's wait for kernels (wall s)", [with_terrains - again], bar=3.0),
        Figure("the same, and for the eight terrains that it builds (wall s)", [first - again]),
    ]


def _caching(folder: Path) -> dict[str, str]:
    return {"MARSYARD_CACHE": str(folder)}


def _wall_s(*words: str, more: dict[str, str] | None = None, allowed: tuple[int, ...] = (0,)) -> float:
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"} | (more or {})
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-m", "marsyard", *words], env=environment, capture_output=True, text=True)
    taken = time.perf_counter() - start
    if done.returncode not in allowed:
        raise RuntimeError(f"marsyard {' '.join(words)} ended with {done.returncode}: {done.stderr}")
    return taken
