"""Parameters of a short rover run for tests."""

from typing import Any

#: A short approach to a rock of 0.8 m, from 3.6 m to 3.3 m, over a small terrain with few other rocks.
SHORT_RUN: dict[str, Any] = {
    "world": {"samples": 1024, "rock_abundance": 0.005, "bank": 1},
    "start": {"distance_m": 3.6},
    "target": {"diameter_m": 0.8, "shape": 8, "yaw_deg": 30.0},
    "sun": {"azimuth_deg": 260.0, "elevation_deg": 50.0},
    "legs": [{"motion": "approach", "goal_m": 3.3, "step_fraction": 0.1}],
}
