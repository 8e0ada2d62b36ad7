"""A scenario whose cases misbehave by chance, as a user's algorithm may."""

from __future__ import annotations

import os
import re
import time

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from marsyard.scenarios.interface import CaseResult
from marsyard.sim.streams import Streams


class ChaosParameters(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    work_s: float = Field(default=0.05, ge=0.0, description="processor time of a case")
    share: float = Field(default=0.0, ge=0.0, le=1.0, description="of cases that misbehave")


#: What a case that misbehaves may do, and the outcome that it is to have.
DEEDS = {"raise": "CRASHED", "loop": "TIMED_OUT", "swell": "OUT_OF_MEMORY", "abort": "CRASHED"}


def deed(parameters: ChaosParameters, streams: Streams) -> str:
    """What a case does; empty where it is healthy."""
    rng = streams.generator("chaos")
    return str(rng.choice(list(DEEDS))) if rng.random() < parameters.share else ""


class ChaosScenario:
    """Works for a while, and then answers, or raises, loops in C, allocates without end, or aborts."""

    name = "chaos"
    parameters_type = ChaosParameters

    def shared_inputs(self, parameters: ChaosParameters) -> tuple[int, ...]:
        return ()

    def prepare(self, parameters: ChaosParameters, shared_input: int) -> None:
        """Nothing: there are no shared inputs."""

    def run(self, parameters: ChaosParameters, streams: Streams) -> CaseResult:
        end = time.process_time() + parameters.work_s
        while time.process_time() < end:
            pass
        done = deed(parameters, streams)
        if done == "raise":
            raise ZeroDivisionError("by chance")
        if done == "loop":
            # two to the power of 64 ways to share the letters out, in C
            re.match("(a+)+$", "a" * 64 + "b")
        if done == "abort":
            os.abort()
        hoard = []
        while done == "swell":
            hoard.append(np.ones(4_000_000))
        number = float(streams.generator("number").normal())
        return CaseResult("VALID", True, {"number": number, "hash": int(streams.generator("hash").integers(2**62))})
