"""The field test of DIMES as a system."""

from pathlib import Path

from marsyard.scenarios.systems import System

SYSTEM = System(
    name="fieldtest",
    title="Field test of DIMES on a helicopter",
    summary="Horizontal velocity of a helicopter from triples of images over desert ground.",
    scenarios={"fieldtest": "marsyard.scenarios.fieldtest.scenario:FieldTestScenario"},
    tasks=("marsyard.scenarios.velocity:VELOCITY",),
    folder=Path(__file__).resolve().parent,
    columns={"fieldtest": "marsyard.scenarios.fieldtest.columns:COLUMNS"},
    report="marsyard.reports.fieldtest.presentation:FIELD_TEST",
    # sources of values, in the notation of `System.conditions`
    conditions={
        "site": ("site",),
        "camera": ("=mer-descent-field",),
        "sun_elevation_deg": ("sun_elevation_deg",),
        "slope_deg": ("site.descent.rms_slope_deg",),
        "optical_depth": ("site.environment.optical_depth",),
        "range_m": ("altitude_[0-9]*_m",),
    },
)
