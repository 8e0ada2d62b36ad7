"""Commit of the program, and the proof by git that no entry of a record of confirmations was removed.

A record is registered if it is committed to a git repository, and every version of a record in the history of all
branches is a beginning of the present file. A record that was deleted, replaced or shortened after a commit is
therefore recognised.
"""

import hashlib
import os
import shutil
import subprocess
from pathlib import Path

from marsyard.campaigns.definition.campaign import CONFIRMATIONS_FILE

#: Beginning of each reason why a record is not registered.
UNKNOWN = "No record of earlier runs is known here"
#: Time limit of one call of git, s.
_TIMEOUT_S = 60.0
#: Folder of the program, with `scenarios`.
_PACKAGE_FOLDER = Path(__file__).resolve().parents[2]


def git_commit() -> str | None:
    """Return the git commit of the program, with ``+changes`` if tracked files were edited; None if unknown."""
    source = Path(__file__).resolve()
    try:
        if not _run_git(source.parent, "ls-files", source.name):
            return None
        commit = _run_git(source.parent, "rev-parse", "HEAD")
        changes = _run_git(source.parent, "status", "--porcelain", "--untracked-files=no")
    except (subprocess.SubprocessError, OSError):
        return None
    return f"{commit}+changes" if changes else commit


def find_registration_problem(path: Path) -> str:
    """Describe why a record is not registered, in a sentence; empty if it is."""
    if not path.is_file():
        return f"{UNKNOWN}: {path} does not exist."
    path = path.resolve()
    if path.name != CONFIRMATIONS_FILE:
        return f"{UNKNOWN}: {path} is not named {CONFIRMATIONS_FILE}."
    if _find_repository(path.parent) is None:
        return f"{UNKNOWN}: {path} is in no git repository."
    try:
        return _check_history(path)
    except (subprocess.SubprocessError, OSError, ValueError, IndexError) as error:
        return f"{UNKNOWN}: git cannot read the history of {path} ({error})."


def _check_history(path: Path) -> str:
    """Compare the committed versions of all records of the repository with the present content of a record."""
    folder = path.parent
    if _run_git(folder, "rev-parse", "--is-shallow-repository") == "true":
        return f"{UNKNOWN}: the git repository is a shallow clone, without its history."
    if not _run_git(folder, "ls-tree", "HEAD", "--", f"./{path.name}", check=False):
        return f"{UNKNOWN}: {path} is not committed."
    options = ("--all", "--full-history", "-m", "--raw", "--no-abbrev", "--no-renames", "--format=")
    changes = _run_git(folder, "log", *options, "--", f":(top,glob)**/{CONFIRMATIONS_FILE}").splitlines()
    versions: dict[str, str] = {}
    for line in changes:
        fields, _, name = line.partition("\t")
        _old_mode, _new_mode, _old_object, new_object, _kind = fields.split()  # a line of `--raw`
        versions.setdefault(new_object, name)
    objects = _run_git(folder, "cat-file", "--batch-check", text="\n".join(versions)).splitlines()
    content = path.read_bytes()
    for entry in objects:
        name, kind, *sizes = entry.split()
        if kind == "missing":  # the object name of a deletion, which consists of zeros
            continue
        size = int(sizes[0])
        if _object_name(content[:size], len(name)) != name:
            return f"{UNKNOWN}: a committed version of {versions[name]} is not the beginning of {path}."
    return ""


def find_campaign_file_problem(record: Path, campaign_file: Path | None) -> str:
    """Describe that a campaign file belongs to another repository than the record; empty if it does not.

    Campaigns of the catalogue, and those without a file (None), may be confirmed in any repository.
    """
    if campaign_file is None or is_catalogue_file(campaign_file):
        return ""
    path = campaign_file.resolve()
    if _find_repository(path.parent) == _find_repository(record.resolve().parent):
        return ""
    return f"{UNKNOWN}: {path} is not in the git repository of {record}."


def is_catalogue_file(campaign_file: Path) -> bool:
    """Whether a campaign file is part of the program."""
    return campaign_file.resolve().is_relative_to(_PACKAGE_FOLDER / "scenarios")


def _find_repository(folder: Path) -> str | None:
    """Return the folder of the git repository that contains a folder; None without one, or without git."""
    try:
        return _run_git(folder, "rev-parse", "--show-toplevel") or None
    except (subprocess.SubprocessError, OSError):
        return None


def _object_name(content: bytes, digits: int) -> str:
    """Compute the name of a git object with a content: a hash of 40 (SHA-1) or 64 digits (SHA-256)."""
    algorithm = "sha256" if digits == 64 else "sha1"
    return hashlib.new(algorithm, b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()


def _run_git(folder: Path, *arguments: str, text: str | None = None, check: bool = True) -> str:
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
