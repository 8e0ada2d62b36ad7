"""Fast scenarios without terrain and rendering for the tests of campaigns; parameters select the failing cases."""

from __future__ import annotations

import os
import re
import signal
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from marsyard.algorithms.exchange import ExecutableLimits
from marsyard.scenarios.interface import CaseResult
from marsyard.scenarios.velocity import VELOCITY
from marsyard.sim.array_cache import CacheWarning
from marsyard.sim.streams import Streams


class Wind(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    east_m_s: float = Field(default=0.0, ge=-50.0, le=50.0)
    north_m_s: float = Field(default=0.0, ge=-50.0, le=50.0)


class FakeParameters(BaseModel):
    """Parameters of `FakeScenario`.

    - *_cases: numbers of the cases with this fault
    - shared: number of shared inputs; fail_prepare: their preparation fails; cache: folder with a file per input
    - bank_seed: seed of the terrains; is_imported: all terrains are on one imported DTM
    - table: path of an input file; products: "good", or "bad" for products that cannot be stored
    - error_scale: standard deviation of each velocity error component, m/s; sleep_s: duration of a case
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    altitude_m: float = Field(default=2000.0, gt=0.0)
    lowest_altitude_m: float = Field(default=0.0, ge=0.0)
    terrain: int = Field(default=0, ge=0, le=99_999)
    bank_seed: int = Field(default=1, ge=0)
    is_imported: bool = False
    kind: str = Field(default="plain", pattern="^[a-z]+$")
    wind: Wind = Wind()
    heights_m: tuple[float, float] = (1.0, 2.0)
    raising_cases: frozenset[int] = frozenset()
    aborting_cases: frozenset[int] = frozenset()
    unanswered_cases: frozenset[int] = frozenset()
    looping_cases: frozenset[int] = frozenset()
    allocating_cases: frozenset[int] = frozenset()
    flooding_cases: frozenset[int] = frozenset()
    exiting_cases: frozenset[int] = frozenset()
    forking_cases: frozenset[int] = frozenset()
    stopping_cases: frozenset[int] = frozenset()
    state_changing_cases: frozenset[int] = frozenset()
    shared: int = 0
    fail_prepare: bool = False
    cache: str = ""
    sleep_s: float = 0.0
    error_scale: float = 1.0
    products: str = "good"
    table: str = ""

    def input_files(self) -> tuple[str, ...]:
        return (self.table,) if self.table else ()

    @model_validator(mode="after")
    def _check_altitude(self) -> FakeParameters:
        if self.altitude_m < self.lowest_altitude_m:
            raise ValueError("altitude_m must be above lowest_altitude_m")
        return self


def inject_faults(parameters: FakeParameters, case: int) -> None:
    """Loop, print, exit, fork, stop the parent, change the process state or allocate memory, as parameters select."""
    if case in parameters.looping_cases:
        # backtracks 2^64 times in C without releasing the interpreter lock
        re.match("(a+)+$", "a" * 64 + "b")
    while case in parameters.flooding_cases:
        os.write(1, b"another line of text\n" * 1000)
    if case in parameters.exiting_cases:
        os._exit(0)
    if case in parameters.forking_cases and os.fork() == 0:
        # the child starts its own session, inherits the worker's open files and creates a temporary file
        os.setsid()
        Path(tempfile.gettempdir(), "temporary-file").touch()
        time.sleep(3600)
    if case in parameters.stopping_cases:
        os.kill(os.getppid(), signal.SIGSTOP)
    if case in parameters.state_changing_cases:
        os.chdir("/")
    arrays = []
    while case in parameters.allocating_cases:
        arrays.append(np.ones(1_000_000))


class ScenarioWithoutInputs:
    """Base of scenarios whose cases share no inputs."""

    def shared_inputs(self, parameters: Any) -> tuple[int, ...]:
        return ()

    def prepare(self, parameters: Any, shared_input: int) -> None:
        raise AssertionError("the cases share no inputs")


class FakeScenario:
    name = "fake"
    parameters_type: type[FakeParameters] = FakeParameters

    def shared_inputs(self, parameters: FakeParameters) -> tuple[int, ...]:
        return tuple(range(parameters.shared))

    def prepare(self, parameters: FakeParameters, shared_input: int) -> None:
        if parameters.fail_prepare:
            raise OSError("the disk is full")
        Path(parameters.cache, f"shared-{shared_input}").touch()

    def terrain_identities(self, parameters: FakeParameters, case: int) -> tuple[str, ...]:
        if parameters.is_imported:
            # not at the top: each of hundreds of worker processes would import the terrain models
            from marsyard.sim.terrain.bank import IMPORTED_TERRAIN

            return (f"{IMPORTED_TERRAIN} file",)
        return (f"{parameters.bank_seed} {parameters.terrain}",)

    def run(self, parameters: FakeParameters, streams: Streams) -> CaseResult:
        time.sleep(parameters.sleep_s)
        if streams.case in parameters.raising_cases:
            raise ZeroDivisionError(f"case {streams.case} of {object()!r}")
        if streams.case in parameters.aborting_cases:
            os.abort()
        inject_faults(parameters, streams.case)
        has_answer = streams.case not in parameters.unanswered_cases
        # the environment variable imitates a change of the algorithm's code
        scale = parameters.error_scale * float(os.environ.get("FAKE_ERROR_SCALE", "1"))
        # the environment variable imitates a bad result by chance
        if str(streams.case) in os.environ.get("FAKE_FAILING_CASES", "").split():
            scale *= 1e9
        error = scale * streams.generator("noise").normal(size=2) if has_answer else np.full(2, np.nan)
        row = {
            "velocity_error_m_s": np.hypot(*error),
            "velocity_error_x_m_s": error[0],
            "altitude_m": parameters.altitude_m,
            "wind_east_m_s": parameters.wind.east_m_s,
            "terrain": np.int64(parameters.terrain),
            "kind": parameters.kind,
            "clear": np.bool_(parameters.terrain == 0),
            "threads": os.environ["OMP_NUM_THREADS"],
            "hash_of_text": hash("marsyard") % 2**31,
        }
        products = {"image": np.arange(6, dtype=np.uint16).reshape(2, 3), "title": "a", "nested": [{"x": np.eye(2)}]}
        if parameters.products == "bad":
            products = {"unsupported": object()}
        return CaseResult("VALID" if has_answer else "SILENT", has_answer, row, products)


class SelectingScenario(FakeScenario):
    """A scenario in which each case uses the shared input with the number of its terrain."""

    def prepare(self, parameters: FakeParameters, shared_input: int) -> None:
        super().prepare(parameters, shared_input)
        warnings.warn(f"input {shared_input} was damaged", CacheWarning, stacklevel=2)

    def case_inputs(self, parameters: FakeParameters, case: int) -> tuple[int, ...]:
        return (parameters.terrain,)

    def missing_bytes(self, parameters: FakeParameters, shared_input: int) -> int:
        return 0 if Path(parameters.cache, f"shared-{shared_input}").exists() else 1_000_000


class TestedParameters(FakeParameters):
    """Parameters of `TestedScenario`; `algorithm` is the path ``module:Class`` of a class in the current folder."""

    __test__ = False

    terrain: int = Field(default=0, ge=0, le=99)
    algorithm: str
    compared: tuple[str, ...] = ()
    executable: ExecutableLimits = ExecutableLimits()


class TestedScenario(FakeScenario):
    """A scenario with an algorithm under test, which it does not call."""

    __test__ = False

    name = "tested"
    parameters_type = TestedParameters
    task = VELOCITY
    algorithm_table: tuple[str, ...] = ()
