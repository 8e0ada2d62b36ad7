"""Test of the memory that is freed after rendering."""

import subprocess
import sys

SIZE = 20_000_000
#: Frees the memory of several images, then prints the memory in use before and after it is returned.
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


def _measure_memory(word: str) -> tuple[int, int]:
    done = subprocess.run([sys.executable, "-c", SCRIPT, word], capture_output=True, text=True, check=True)
    freed, returned = map(int, done.stdout.split())
    return freed, returned


def test_freed_memory_is_kept_until_it_is_returned() -> None:
    freed, returned = _measure_memory("keep")
    assert freed > 0.9 * SIZE
    assert returned < 0.1 * SIZE
    # The default behaviour of the C library.
    assert _measure_memory("as it is")[0] < 0.1 * SIZE
