"""Confirm the campaigns of a list, one after another: ``python tools/confirm_queue.py --help``.

A line of the list contains a campaign, its number of cases and of worker processes; ``#`` begins a comment. The record
of confirmations is committed after each campaign. A repeated call skips complete campaigns, resumes interrupted ones,
and repeats those without a folder with the seeds of their entry in the record. All campaigns run on one source tree:
the program stops if tracked files have changes, or if the log (``queue.log``) was begun on another tree. Pages, tests,
tools, measurements, studies and the command line do not determine the rows of a campaign, so they are no part of the
tree; nor are the reports, which ``marsyard report`` writes again from the rows. Exit code: 0 if all campaigns are
complete, with any verdict; 1 if one is not; 2 for invalid input.
"""

import argparse
import datetime as dt
import hashlib
import json
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

#: Patterns of git for the files that do not determine rows.
_NO_SOURCES = tuple(
    f":(exclude){path}"
    for path in ("*.md", "docs", "benchmarks", "tests", "tools", "reports", "marsyard", "campaigns/studies")
)


class Entry(NamedTuple):
    """A campaign of the list, with its number of cases and of worker processes."""

    campaign: str
    cases: int
    jobs: int


def read_list(path: Path) -> list[Entry]:
    """Read a list; raises ValueError that names the line."""
    entries: list[Entry] = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        if len(words) != 3 or not all(word.isdigit() and int(word) > 0 for word in words[1:]):
            raise ValueError(f"{path}, line {number}: {line.strip()!r}; allowed: CAMPAIGN CASES JOBS, numbers above 0")
        entries.append(Entry(words[0], int(words[1]), int(words[2])))
    if len({Path(entry.campaign).stem for entry in entries}) < len(entries):
        raise ValueError(f"{path}: a campaign occurs twice; allowed: once")
    return entries


def git(*arguments: str) -> str:
    """Run git in the current folder, and return its output; raises ValueError with its message."""
    result = subprocess.run(["git", *arguments], capture_output=True, text=True, check=False)  # noqa: S603, S607
    if result.returncode:
        raise ValueError(f"git {' '.join(arguments)}: {result.stderr.strip()}")
    return result.stdout


def hash_tree(record: Path, log: Path) -> str:
    """Hash the committed sources; raises ValueError if one of them has changes, or if the log contains another hash."""
    files = ("--", ":/", *_NO_SOURCES, f":(exclude){record}")
    changed = git("status", "--porcelain", "--untracked-files=no", *files).split("\n")[0]
    if changed:
        raise ValueError(f"the tree has changes ({changed.strip()}): commit them before a confirmation")
    tree = hashlib.sha256(git("ls-files", "--stage", "--full-name", *files).encode()).hexdigest()[:16]
    others = {line.split()[1] for line in log.read_text().splitlines()} - {tree} if log.exists() else set()
    if others:
        raise ValueError(f"{log} was begun on the tree {', '.join(others)}; this is {tree}: use another --out")
    return tree


def is_finished(directory: Path) -> bool:
    """Whether a folder contains all cases of its campaign and its report."""
    path = directory / "campaign.json"
    state = json.loads(path.read_text(encoding="utf-8"))["state"] if path.exists() else None
    return state == "finished" and (directory / "report.json").exists()


def run_entry(entry: Entry, out: Path, record: Path) -> bool:
    """Run or continue a campaign, and commit the record; return whether the campaign is complete."""
    directory, tree = out / Path(entry.campaign).stem, hash_tree(record, out / "queue.log")
    if is_finished(directory):
        return True
    arguments = ["resume", str(directory)]
    if not (directory / "campaign.json").exists():
        arguments = ["run", entry.campaign, "--confirm", "--cases", str(entry.cases), "--out", str(directory)]
        arguments += ["--confirmations", str(record)]
    command = [sys.executable, "-m", "marsyard", *arguments, "--jobs", str(entry.jobs)]
    write_log(out, tree, f"start: marsyard {' '.join(arguments)}")
    with directory.with_suffix(".log").open("ab") as output:
        subprocess.run(command, stdout=output, stderr=output, check=False)  # noqa: S603
    is_complete = is_finished(directory)
    if git("status", "--porcelain", "--", str(record)):
        git("commit", "--quiet", "--message", f"Confirmation of {directory.name}", "--", str(record))
    write_log(out, tree, f"end: {directory.name} is {'complete' if is_complete else 'not complete'}")
    return is_complete


def write_log(out: Path, tree: str, text: str) -> None:
    """Print a line with time and tree, and add it to the log."""
    line = f"{dt.datetime.now(dt.UTC).isoformat(timespec='seconds')} {tree} {text}"
    print(line, flush=True)
    with (out / "queue.log").open("a", encoding="utf-8") as file:
        file.write(line + "\n")


def main(arguments: list[str] | None = None) -> int:
    """Run the list; see the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("list", type=Path, nargs="?", default=Path(__file__).with_name("confirmations.txt"))
    parser.add_argument("--out", type=Path, default=Path("runs/confirmations"), help="folder of the runs and the log")
    parser.add_argument(
        "--record",
        type=Path,
        default=Path("benchmarks/results/confirmations.jsonl"),
        help="record of confirmations; default: that of this project",
    )
    options = parser.parse_args(arguments)
    try:
        entries = read_list(options.list)
        options.out.mkdir(parents=True, exist_ok=True)
        complete = [run_entry(entry, options.out, options.record) for entry in entries]
    except (OSError, ValueError) as error:
        print(f"confirm_queue: {error}", file=sys.stderr)
        return 2
    return int(not all(complete))


if __name__ == "__main__":
    raise SystemExit(main())
