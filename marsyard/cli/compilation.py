"""Command `marsyard compile`: compile the numeric kernels before the first run."""

import time
from collections.abc import Sequence

import typer

from marsyard.cli.errors import handle_user_errors


@handle_user_errors
def compile_kernels() -> None:
    """Compile the numeric kernels before the first run, by running a small descent, drive and landing.

    The compiled code is cached and valid until the source code changes.
    """
    from joblib import Parallel, delayed

    from marsyard.campaigns.running.compilation import list_compilations
    from marsyard.sim.kernel_cache import kernels_are_ready

    missing = []
    for item in list_compilations():
        if kernels_are_ready(item[0]):
            typer.echo(f"{item[0]}: already compiled")
        else:
            missing.append(item)
    # all scenarios call the kernels of the renderer: the first one compiles them, then the others run in parallel
    for group, jobs in ((missing[:1], 1), (missing[1:], 2)):
        if group:
            lines = Parallel(n_jobs=jobs, return_as="generator")(delayed(_compile_scenario)(*item) for item in group)
            for line in lines:
                typer.echo(line)


def _compile_scenario(scenario: str, name: str, overrides: Sequence[str]) -> str:
    """Compile the kernels of a scenario; return a line of text."""
    from marsyard.campaigns.execution.worker_process import limit_threads
    from marsyard.campaigns.running.compilation import compile_campaign

    limit_threads()
    start_s = time.monotonic()
    compile_campaign(name, overrides)
    return f"{scenario}: compiled, {time.monotonic() - start_s:.0f} s"
