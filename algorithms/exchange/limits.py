"""Limits and isolation of an algorithm in a process of its own: the parameters `executable` of a campaign."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

from marsyard.algorithms.exchange.sandbox import find_problem

#: Device without an accelerator.
CPU = "cpu"


class ExecutableLimits(BaseModel):
    """Limits and isolation of an algorithm in a process of its own: a program, or a custom Python class.

    The limits apply to one case or request; that of the files applies to all files that exist at one time.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    time_s: Annotated[float, Field(gt=0.0, le=86400.0, description="wall-clock time for an answer, s")] = 60.0
    total_s: Annotated[
        float, Field(gt=0.0, le=864000.0, description="wall-clock time for all answers to one case, s")
    ] = 600.0
    loading_s: Annotated[
        float, Field(gt=0.0, le=86400.0, description="wall-clock time to import and construct a Python class, s")
    ] = 300.0
    memory_gb: Annotated[float, Field(gt=0.0, le=4096.0, description="resident memory of its process tree")] = 2.0
    output_mb: Annotated[float, Field(gt=0.0, le=1000.0, description="size of its standard output and error")] = 1.0
    files_mb: Annotated[float, Field(gt=0.0, le=1e6, description="size of the files in its temporary folder")] = 100.0
    isolated: Annotated[
        bool, Field(description="custom Python classes run in a process of their own; false: in the worker, to debug")
    ] = True
    devices: Annotated[
        tuple[str, ...], Field(min_length=1, description="devices, such as cuda:0, given to the workers in turn")
    ] = (CPU,)
    sandbox: Annotated[
        bool, Field(description="untrusted: without network, other processes, and files except its own (bubblewrap)")
    ] = False
    visible: Annotated[
        tuple[str, ...], Field(description="further files and folders that it can read in the sandbox")
    ] = ()

    @model_validator(mode="after")
    def _check_sandbox(self) -> ExecutableLimits:
        if self.sandbox and (problem := find_problem()):
            raise ValueError(f"this machine has no sandbox: {problem}")
        if self.sandbox and set(self.devices) != {CPU}:
            raise ValueError(f"devices are {', '.join(self.devices)}; allowed in the sandbox: {CPU}")
        if self.sandbox and not self.isolated:
            raise ValueError("isolated is false; allowed in the sandbox: true")
        return self
