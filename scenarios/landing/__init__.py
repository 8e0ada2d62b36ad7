"""A helicopter, or a lander, that looks for a place to land in two pictures (Johnson, Montgomery & Matthies)."""

from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.scenario import LandingScenario

__all__ = ["LandingScenario", "LandingScenarioParameters"]
