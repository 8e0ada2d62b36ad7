"""Common to the commands that run cases: workers, output folder, progress and interruption, evaluation at the end."""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from marsyard.cli.errors import Exit
from marsyard.cli.terminal import create_console

if TYPE_CHECKING:
    from marsyard.campaigns.execution.executors import ExecutorConfig
    from marsyard.campaigns.running.progress import ProgressObserver


def make_executor(jobs: int | None, cluster: str | None) -> ExecutorConfig:
    """Create the parameters of the workers from the options `--jobs` and `--cluster`."""
    from marsyard.campaigns.errors import CampaignError
    from marsyard.campaigns.execution.executors import ExecutorConfig, available_cores

    if jobs is not None and jobs < 1:
        raise CampaignError(f"--jobs {jobs}: at least one worker process is needed")
    if jobs is not None and cluster is not None:
        raise CampaignError("--jobs and --cluster cannot be combined: a cluster has its own workers")
    return ExecutorConfig(jobs or available_cores(), cluster)


def run_and_evaluate(directory: Path, work: Callable[[ProgressObserver], None]) -> None:
    """Run the campaign by the function `work`, evaluate it, and exit with the status of its verdict."""
    from marsyard.cli.outcome import evaluate_and_report
    from marsyard.cli.progress import RunLog

    with show_progress(directory) as progress, RunLog(directory, progress) as log:
        work(log)
    raise typer.Exit(evaluate_and_report(directory, create_console()))


@contextmanager
def show_progress(directory: Path, next_command: str = "") -> Iterator[ProgressObserver]:
    """Show the progress of a campaign; an interruption prints the command that continues it, and exits with 130."""
    from marsyard.campaigns.errors import CampaignError
    from marsyard.campaigns.store.record import read
    from marsyard.cli.progress import campaign_progress

    try:
        with stop_on_signals(), campaign_progress(create_console(stderr=True)) as progress:
            yield progress
    except KeyboardInterrupt:
        try:
            stored = read(directory)
            rows = f"the rows so far are in {directory} ({stored['cases_finished']} of {stored['cases']})"
            typer.echo(f"interrupted; {rows}. To continue: {next_command or f'marsyard resume {directory}'}", err=True)
        except CampaignError:  # interrupted before the record was written: there are no rows
            pass
        raise typer.Exit(Exit.INTERRUPTED) from None


@contextmanager
def stop_on_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt at the first Ctrl-C or SIGTERM; exit immediately at the second."""

    def interrupt(number: int, _frame: object) -> None:
        for handled_signal in (signal.SIGINT, signal.SIGTERM):
            signal.signal(handled_signal, exit_immediately)
        raise KeyboardInterrupt(signal.Signals(number).name)

    def exit_immediately(_number: int, _frame: object) -> None:
        # the workers' supervisors detect the end of this process, kill their children and remove temporary files
        os.write(2, b"\x1b[?25hkilled\n" if os.isatty(2) else b"killed\n")
        os._exit(Exit.INTERRUPTED)

    previous_handlers = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


def default_directory(name: str, parent: Path = Path("runs")) -> Path:
    """Return the path of a new folder ``runs/<campaign>-<UTC time>``, with a number if that folder exists."""
    from datetime import UTC, datetime

    base = parent / f"{name}-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    numbered_folders = (base.with_name(f"{base.name}-{number}") for number in itertools.count(2))
    return next(folder for folder in itertools.chain([base], numbered_folders) if not folder.exists())
