"""Memory that pictures have freed."""

import subprocess
import sys

SIZE = 20_000_000
#: Frees as much as some pictures take, and tells how much more memory is in use then, and after it has gone back.
SCRIPT = f"""
import os, sys
from marsyard.sim.render.renderer import keep_freed_memory, return_freed_memory

def used():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

if sys.argv[1] == "keep":
    keep_freed_memory()
before = used()
pictures = b"1" * {SIZE}
del pictures
freed = used()
return_freed_memory()
print(freed - before, used() - before)
"""


def _in_use(word: str) -> tuple[int, int]:
    done = subprocess.run([sys.executable, "-c", SCRIPT, word], capture_output=True, text=True, check=True)
    freed, returned = map(int, done.stdout.split())
    return freed, returned


def test_freed_memory_is_kept_until_it_is_returned() -> None:
    freed, returned = _in_use("keep")
    assert freed > 0.9 * SIZE
    assert returned < 0.1 * SIZE
    # what the C library does by itself
    assert _in_use("as it is")[0] < 0.1 * SIZE
