"""Test that the process retains freed memory between images, and returns it to the operating system on request."""

import subprocess
import sys

import pytest

#: Size of the block, bytes.
SIZE = 20_000_000
#: Allocates and frees a large block. Prints the bytes still in use before and after the memory is returned.
SCRIPT = f"""
import os, sys
from marsyard.sim.render.renderer import keep_freed_memory, return_freed_memory

def resident_bytes():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

if sys.argv[1] == "keep":
    keep_freed_memory()
before = resident_bytes()
block = b"1" * {SIZE}
del block
after_free = resident_bytes()
return_freed_memory()
print(after_free - before, resident_bytes() - before)
"""


def _measure_memory(mode: str) -> tuple[int, int]:
    """Return the bytes in use after the block is freed, and after the memory is returned to the system."""
    result = subprocess.run([sys.executable, "-c", SCRIPT, mode], capture_output=True, text=True, check=True)
    bytes_after_free, bytes_after_return = map(int, result.stdout.split())
    return bytes_after_free, bytes_after_return


@pytest.mark.slow
def test_process_retains_freed_memory_until_it_is_returned() -> None:
    bytes_after_free, bytes_after_return = _measure_memory("keep")
    assert bytes_after_free > 0.9 * SIZE
    assert bytes_after_return < 0.1 * SIZE
    # By default the C library returns freed memory at once.
    assert _measure_memory("default")[0] < 0.1 * SIZE
