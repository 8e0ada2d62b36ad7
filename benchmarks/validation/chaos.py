"""A scenario with random faults of a custom algorithm: exception, endless loop, memory overrun, abort."""

import os
import re
import time
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from marsyard.scenarios.interface import CaseResult
from marsyard.sim.streams import Streams


class ChaosParameters(BaseModel):
    """Parameters of the fault injection."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    work_s: float = Field(default=0.05, ge=0.0, description="processor time of a case")
    faulty_fraction: float = Field(default=0.0, ge=0.0, le=1.0, description="fraction of cases that misbehave")


#: Faults of misbehaving cases, and their expected outcomes.
FAULTS = {"raise": "CRASHED", "loop": "TIMED_OUT", "allocate": "OUT_OF_MEMORY", "abort": "CRASHED"}


def draw_fault(parameters: Any, streams: Streams) -> str:
    """Draw the fault of a case; empty for a case without fault."""
    rng = streams.generator("chaos")
    return str(rng.choice(list(FAULTS))) if rng.random() < parameters.faulty_fraction else ""


class WithoutSharedInputs:
    """Base class of scenarios whose cases share no inputs."""

    def shared_inputs(self, parameters: Any) -> tuple[int, ...]:
        return ()

    def prepare(self, parameters: Any, shared_input: int) -> None:
        """There are no shared inputs."""


class ChaosScenario(WithoutSharedInputs):
    """Scenario that computes for `work_s`, then answers, raises, loops in C, allocates without end, or aborts."""

    name = "chaos"
    parameters_type = ChaosParameters

    def run(self, parameters: ChaosParameters, streams: Streams) -> CaseResult:
        end = time.process_time() + parameters.work_s
        while time.process_time() < end:
            pass
        fault = draw_fault(parameters, streams)
        if fault == "raise":
            raise ZeroDivisionError("by chance")
        if fault == "loop":
            # backtracks 2^64 times in C
            re.match("(a+)+$", "a" * 64 + "b")
        if fault == "abort":
            os.abort()
        arrays = []
        while fault == "allocate":
            arrays.append(np.ones(4_000_000))
        number = float(streams.generator("number").normal())
        return CaseResult("VALID", True, {"number": number, "hash": int(streams.generator("hash").integers(2**62))})
