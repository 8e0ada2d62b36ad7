"""`marsyard compile`: compiles the numeric kernels ahead of the first run."""

from __future__ import annotations

import time

import typer

from marsyard.cli.campaign import says_what_is_wrong


@says_what_is_wrong
def compile_kernels() -> None:
    """Compile the numeric kernels now, so that the first run does not wait for it.

    Each system runs a small case. What is compiled stays on disk until the code changes (`marsyard clean` tells where).
    """
    from marsyard.campaigns.definition.loading import load_campaign
    from marsyard.campaigns.execution.worker_process import limit_threads
    from marsyard.scenarios.systems import systems
    from marsyard.sim.kernel_cache import kernels_are_ready, note_ready

    limit_threads()
    for name, settings in (one for system in systems() for one in system.compiled_by.items()):
        campaign = load_campaign(name, settings)
        scenario = campaign.configuration.scenario
        if kernels_are_ready(scenario):
            typer.echo(f"{scenario}: compiled before")
            continue
        began = time.monotonic()
        campaign.scenario.run(campaign.parameters(0), campaign.streams(0))
        note_ready(scenario)
        typer.echo(f"{scenario}: compiled, {time.monotonic() - began:.0f} s")
