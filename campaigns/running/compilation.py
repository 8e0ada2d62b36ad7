"""Compilation of the numeric kernels of a scenario, before the first case of a campaign.

A system names small campaigns whose cases call all its kernels; one case of each is run.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain
from typing import NamedTuple

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.execution.work import Executor, Work
from marsyard.scenarios.systems import systems
from marsyard.sim.kernel_cache import kernels_are_ready, mark_ready

#: Note before the first compilation on a machine.
COMPILATION_NOTE = (
    "compiling numeric kernels once on this machine, about a minute (to compile in advance: marsyard compile)"
)


class Compilation(NamedTuple):
    """A campaign that compiles the kernels of its scenario, with the overrides that make its cases small."""

    scenario: str
    campaign: str
    overrides: tuple[str, ...]


def list_compilations(scenario: str | None = None) -> list[Compilation]:
    """List the campaigns that compile the kernels of a scenario's system, or of all systems."""
    compilations = (
        item
        for system in systems()
        if scenario is None or scenario in system.scenarios
        for item in system.compilation_campaigns.items()
    )
    return [
        Compilation(load_campaign(name, overrides).definition.scenario, name, overrides)
        for name, overrides in compilations
    ]


def compile_campaign(name: str, overrides: Sequence[str]) -> None:
    """Run one small case of a campaign, which compiles the kernels of its scenario."""
    campaign = load_campaign(name, overrides)
    campaign.scenario.run(campaign.parameters(0), campaign.streams(0))
    mark_ready(campaign.definition.scenario)


def compile_kernels(executor: Executor, scenario: str, note: Callable[[str], None]) -> None:
    """Compile the kernels of a scenario in a worker, unless they are compiled on this machine.

    Otherwise the first case of each worker would compile them, and an algorithm's computation time would include it.
    """
    if kernels_are_ready(scenario):
        return
    missing = [item for item in list_compilations(scenario) if not kernels_are_ready(item.scenario)]
    if not missing:
        return
    note(COMPILATION_NOTE)
    start_s, work = time.monotonic(), Work(partial(_compile_item, missing), range(len(missing)))
    errors = [result.error for result in chain.from_iterable(executor.run(work)) if result.error is not None]
    for error in errors:
        note(f"numeric kernels could not be compiled: {error}; each worker's first case compiles them")
    if not errors:
        note(f"numeric kernels are compiled, {time.monotonic() - start_s:.0f} s")


def _compile_item(compilations: Sequence[Compilation], number: int) -> None:
    compile_campaign(compilations[number].campaign, compilations[number].overrides)
