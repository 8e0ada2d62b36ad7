"""Test that freed memory stays allocated between images and is returned to the system on request."""

import subprocess
import sys

SIZE = 20_000_000
#: Frees a large block, then prints the bytes still in use before and after the memory is returned to the system.
SCRIPT = f"""
import os, sys
from marsyard.sim.render.renderer import keep_freed_memory, return_freed_memory

def used():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

if sys.argv[1] == "keep":
    keep_freed_memory()
before = used()
block = b"1" * {SIZE}
del block
freed = used()
return_freed_memory()
print(freed - before, used() - before)
"""


def _measure_memory(mode: str) -> tuple[int, int]:
    result = subprocess.run([sys.executable, "-c", SCRIPT, mode], capture_output=True, text=True, check=True)
    freed, returned = map(int, result.stdout.split())
    return freed, returned


def test_freed_memory_stays_allocated_until_it_is_returned() -> None:
    freed, returned = _measure_memory("keep")
    assert freed > 0.9 * SIZE
    assert returned < 0.1 * SIZE
    # The default behaviour of the C library.
    assert _measure_memory("as it is")[0] < 0.1 * SIZE
