"""Registration of a record of confirmations: git shows that no entry of it was removed.

A record is registered if it is committed to a git repository, and every version of a record in the history of all
branches is a beginning of the present file. A record that was deleted, replaced or shortened after a commit is
therefore recognised.
"""

import hashlib
import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from marsyard.campaigns.definition.campaign import CONFIRMATIONS_FILE
from marsyard.campaigns.definition.loading import find_campaign
from marsyard.campaigns.errors import CampaignError

#: Beginning of each reason.
UNKNOWN = "No record of earlier runs is known here"
_TIMEOUT_S = 60.0
_PACKAGE_FOLDER = Path(__file__).resolve().parents[2]


def find_registration_problem(path: Path) -> str:
    """Describe why a record is not registered, in a sentence; empty if it is."""
    if not path.is_file():
        return f"{UNKNOWN}: {path} does not exist."
    path = path.resolve()
    if path.name != CONFIRMATIONS_FILE:
        return f"{UNKNOWN}: {path} is not named {CONFIRMATIONS_FILE}."
    if find_repository(path.parent) is None:
        return f"{UNKNOWN}: {path} is in no git repository."
    try:
        return _check_history(path)
    except (subprocess.SubprocessError, OSError, ValueError, IndexError) as error:
        return f"{UNKNOWN}: git cannot read the history of {path} ({error})."


def _check_history(path: Path) -> str:
    """Compare the committed versions of all records of the repository with the present content of a record."""
    folder = path.parent
    if _git(folder, "rev-parse", "--is-shallow-repository") == "true":
        return f"{UNKNOWN}: the git repository is a shallow clone, without its history."
    if not _git(folder, "ls-tree", "HEAD", "--", f"./{path.name}", check=False):
        return f"{UNKNOWN}: {path} is not committed."
    options = ("--all", "--full-history", "-m", "--raw", "--no-abbrev", "--no-renames", "--format=")
    changes = _git(folder, "log", *options, "--", f":(top,glob)**/{CONFIRMATIONS_FILE}").splitlines()
    # a line of `--raw`: modes and object names before and after the change, the kind of change, a tab, and the path
    versions: dict[str, str] = {}
    for line in changes:
        fields, _, name = line.partition("\t")
        versions.setdefault(fields.split()[3], name)
    objects = _git(folder, "cat-file", "--batch-check", text="\n".join(versions)).splitlines()
    content = path.read_bytes()
    for entry in objects:
        name, kind, *sizes = entry.split()
        if kind == "missing":  # the object name of a deletion, which consists of zeros
            continue
        size = int(sizes[0])
        if _object_name(content[:size], len(name)) != name:
            return f"{UNKNOWN}: a committed version of {versions[name]} is not the beginning of {path}."
    return ""


def find_campaign_file_problem(record: Path, command: Sequence[str]) -> str:
    """Describe that a campaign file belongs to another repository than the record; empty if it does not.

    - command: words of the command that repeats the campaign; the third is the campaign

    Campaigns of the catalogue may be confirmed in any repository.
    """
    try:
        path = find_campaign(command[2]).resolve() if len(command) > 2 else None
    except CampaignError:
        path = None
    if path is None or path.is_relative_to(_PACKAGE_FOLDER / "scenarios"):
        return ""
    if find_repository(path.parent) == find_repository(record.resolve().parent):
        return ""
    return f"{UNKNOWN}: {path} is not in the git repository of {record}."


def find_repository(folder: Path) -> str | None:
    """Return the folder of the git repository that contains a folder; None without one, or without git."""
    try:
        return _git(folder, "rev-parse", "--show-toplevel") or None
    except (subprocess.SubprocessError, OSError):
        return None


def _object_name(content: bytes, digits: int) -> str:
    """Compute the name of a git object with a content: a hash of 40 (SHA-1) or 64 digits (SHA-256)."""
    algorithm = "sha256" if digits == 64 else "sha1"
    return hashlib.new(algorithm, b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()


def _git(folder: Path, *arguments: str, text: str | None = None, check: bool = True) -> str:
    """Run git in a folder and return its output; variables that select another repository are ignored."""
    git = shutil.which("git")
    if git is None:
        raise FileNotFoundError("git is not installed")
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    command = [git, "-C", str(folder), *arguments]
    process = subprocess.run(  # noqa: S603
        command, input=text, capture_output=True, text=True, check=check, timeout=_TIMEOUT_S, env=environment
    )
    return process.stdout.strip()
