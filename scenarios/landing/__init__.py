"""A helicopter, or a lander, that looks for a place to land in two pictures (Johnson, Montgomery & Matthies)."""

from scenarios.landing.parameters import LandingScenarioParameters
from scenarios.landing.scenario import LandingScenario

__all__ = ["LandingScenario", "LandingScenarioParameters"]
