"""Sandbox of an untrusted program: namespaces of its own for files, processes and network, by bubblewrap (`bwrap`).

The program sees the system's folders, Python and Marsyard, its own files and its temporary folder. It sees no other
process, no network, no environment variables of the user, and no other files: neither the folder of the campaign with
its seed, nor the cache of terrains.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

#: Name of the program that creates the namespaces.
PROGRAM = "bwrap"

#: Folders of the system with programs and libraries; missing ones are ignored.
_SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/etc", "/opt")
#: Prefixes of the environment variables that a program in a sandbox receives.
_VARIABLES = ("PATH", "LANG", "LC_", "PYTHONPATH", "PYTHONHASHSEED", "OMP_", "OPENBLAS_", "MKL_", "NUMBA_NUM_")
#: Variables with the values of the program itself.
_OWN_VARIABLES = ("TMPDIR", "MARSYARD_DEVICE")


@cache
def find_problem() -> str:
    """Return why this machine has no sandbox; empty if it has."""
    if shutil.which(PROGRAM) is None:
        return f"the program {PROGRAM} is not installed (package bubblewrap)"
    words = [PROGRAM, "--unshare-all", "--ro-bind", "/", "/", "true"]
    trial = subprocess.run(words, capture_output=True, text=True, check=False)  # noqa: S603
    return "" if trial.returncode == 0 else f"{PROGRAM} cannot create namespaces: {trial.stderr.strip()}"


def sandbox_words(
    words: Sequence[str], environment: Mapping[str, str], folder: Path, working_folder: Path, readable: Sequence[Path]
) -> list[str]:
    """Return the command line that runs a program in a sandbox.

    - folder: the only folder that it can write
    - working_folder: its working folder; only its `readable` files, and those named in the command line, are visible
    - readable: further files and folders that it can read
    """
    program = shutil.which(words[0]) or words[0]
    # `os.path.exists` is false for an empty word, and for words that are too long for a path
    named = [Path(word) for word in words[1:] if os.path.exists(word)]  # noqa: PTH110
    options = ["--unshare-all", "--die-with-parent", "--cap-drop", "ALL", "--proc", "/proc", "--dev", "/dev"]
    options += ["--clearenv", "--setenv", "HOME", str(folder)]
    for name, value in environment.items():
        if name.startswith(_VARIABLES) or name in _OWN_VARIABLES:
            options += ["--setenv", name, value]
    options += ["--dir", str(working_folder)]
    visible: list[Path] = []
    for path in [*map(Path, _SYSTEM), *_python_folders(), Path(program), *named, *readable]:
        if not any(path.absolute().is_relative_to(parent) for parent in visible):
            visible.append(path.absolute())
            options += ["--ro-bind-try", str(visible[-1]), str(visible[-1])]
    options += ["--bind", str(folder), str(folder), "--chdir", str(working_folder), "--"]
    return [PROGRAM, *options, program, *words[1:]]


def _python_folders() -> list[Path]:
    """List the folders of Python and of Marsyard, whose packages are links in a source tree."""
    package = Path(__file__).absolute().parents[2]
    return [Path(sys.prefix), Path(sys.base_prefix), package, *(path.resolve() for path in package.iterdir())]
