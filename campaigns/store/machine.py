"""Machine and program of a session: Python, platform, processor, and git commit of the sources."""

import platform
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

from marsyard.sim.kernel_cache import processor_features


def git_commit() -> str | None:
    """Return the git commit of the program, with ``+changes`` if tracked files were edited; None if unknown."""
    git, source = shutil.which("git"), Path(__file__).resolve()
    outputs = []
    commands = (["rev-parse", "HEAD"], ["ls-files", source.name], ["status", "--porcelain", "--untracked-files=no"])
    try:
        for arguments in commands if git is not None else ():
            command = [str(git), "-C", str(source.parent), *arguments]
            process = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)  # noqa: S603
            outputs.append(process.stdout.strip())
    except (subprocess.SubprocessError, OSError):
        return None
    if git is None or not outputs[1]:
        return None
    commit, _, changes = outputs
    return f"{commit}+changes" if changes else commit


def describe_machine() -> dict[str, Any]:
    """Describe Python, platform and processor (with a hash of its features).

    Machines with equal descriptions compute bit-identical rows.
    """
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    model = re.search(r"^(?:model name|CPU part)\s*:\s*(.*)$", text, re.MULTILINE)
    return {
        "python": platform.python_version(),
        "implementation": platform.python_implementation(),
        "platform": platform.platform(),
        "machine": platform.machine(),
        "processor": model[1] if model else platform.processor(),
        "processor_features": processor_features(),
    }
