"""Simulated flight of a landing case with its world, images and ground truth."""

from __future__ import annotations

from dataclasses import dataclass

from marsyard.scenarios.base import LoadGround
from marsyard.scenarios.cameras import camera_optics
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.ground_truth import GroundTruth
from marsyard.scenarios.landing.images import Pair, take_images
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.world import LandingWorld
from marsyard.scenarios.views import SiteGround
from marsyard.sim.streams import Streams


@dataclass(frozen=True)
class RenderedFlight:
    """A flight with its world, images and ground truth."""

    p: LandingScenarioParameters
    world: LandingWorld
    flight: LandingFlight
    pair: Pair
    truth: GroundTruth

    @classmethod
    def simulate(
        cls, p: LandingScenarioParameters, streams: Streams, load_ground: LoadGround = SiteGround.from_bank
    ) -> RenderedFlight:
        """Simulate the flight of a case and take its images."""
        world = LandingWorld.from_parameters(p, load_ground)
        flight = LandingFlight.from_parameters(p, world.ground.surface, streams)
        pair = take_images(p, world, flight, camera_optics(p.optics), streams)
        return cls(p, world, flight, pair, GroundTruth.from_images(world, flight, pair, p.lander.limits))
