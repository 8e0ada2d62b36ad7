"""The helicopter's on-board filter."""

from marsyard.sim.sensor.navigation.filter import (
    FilterParameters,
    FilterState,
    Innovations,
    NavigationFilter,
    NavigationSolution,
)

__all__ = ["FilterParameters", "FilterState", "Innovations", "NavigationFilter", "NavigationSolution"]
