"""Estimators that hand their measurements to a program, and read its answer."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from algorithms.answers import checked_site, checked_velocity
from algorithms.exchange import serving
from algorithms.exchange.files import EXCHANGE, write_case
from algorithms.exchange.process import Child, Command, ExecutableLimits, Said
from algorithms.exchange.replies import ProgramDetails, check_keys, in_its_words, member, numbers, table_of
from algorithms.interface import SiteEstimate, SiteOutcome, VelocityEstimate, VelocityOutcome
from sim.measurements import DescentMeasurements, LandingMeasurements


@dataclass(frozen=True)
class ExecutableVelocityEstimator:
    """A velocity estimator that is a program. Raises AlgorithmError where that fails to answer."""

    command: Command
    limits: ExecutableLimits

    def estimate(self, measurements: DescentMeasurements) -> VelocityEstimate:
        """The program's answer."""
        answer, details = _asked(self.command, self.limits, measurements)
        return in_its_words(details.stderr, lambda: checked_velocity(_velocity(answer, details)))


@dataclass(frozen=True)
class ExecutableSiteEstimator:
    """An estimator of landing sites that is a program. Raises AlgorithmError where that fails to answer."""

    command: Command
    limits: ExecutableLimits

    def estimate(self, measurements: LandingMeasurements) -> SiteEstimate:
        """The program's answer."""
        answer, details = _asked(self.command, self.limits, measurements)
        return in_its_words(details.stderr, lambda: checked_site(_site(answer, details)))


def _velocity(answer: Mapping[str, Any], details: ProgramDetails) -> VelocityEstimate:
    check_keys(answer, {"outcome", "velocity_m_s", "covariance_m2_s2"})
    return VelocityEstimate(
        outcome=member(answer, "outcome", VelocityOutcome),
        velocity_m_s=numbers(answer, "velocity_m_s", (2,)),
        details=details,
        covariance_m2_s2=numbers(answer, "covariance_m2_s2", (2, 2)),
    )


def _site(answer: Mapping[str, Any], details: ProgramDetails) -> SiteEstimate:
    check_keys(answer, {"outcome", "site_world"})
    return SiteEstimate(
        outcome=member(answer, "outcome", SiteOutcome),
        site_world=numbers(answer, "site_world", (3,)),
        details=details,
    )


def _asked(
    command: Command, limits: ExecutableLimits, measurements: DescentMeasurements | LandingMeasurements
) -> tuple[Mapping[str, Any], ProgramDetails]:
    """Hands a case to a program; its answer, read but not checked."""
    with tempfile.TemporaryDirectory(prefix="marsyard-case-") as folder:
        write_case(Path(folder), measurements)
        said = _persistent(command, limits, folder) if command.persistent else _once(command, limits, folder)
    return table_of(said), ProgramDetails(said.stderr, said.time_s)


def _once(command: Command, limits: ExecutableLimits, folder: str) -> Said:
    return Child((*command.words, folder), limits).answer()


def _persistent(command: Command, limits: ExecutableLimits, folder: str) -> Said:
    """An answer of a program that runs on; one that fails is ended, and started anew for the next case."""
    child = serving.taken(command, limits)
    said = child.line(json.dumps({"exchange": EXCHANGE, "case": folder}))
    serving.given_back(command, limits, child)
    return said
