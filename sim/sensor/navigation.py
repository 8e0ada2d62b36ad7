"""Attitude, inertial velocity and time as the lander's computer has them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import Rotation

from sim.measurements import AttitudeMeasurement

NonNegative = Annotated[float, Field(ge=0.0)]


class NavigationParameters(BaseModel):
    """Errors of inertial navigation and of time tags: one standard deviation, per axis where there are axes."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    attitude_bias_deg: Annotated[NonNegative, Field(le=20.0, description="common to a descent's measurements")] = 0.15
    attitude_noise_deg: Annotated[NonNegative, Field(le=20.0, description="new in every measurement")] = 0.01
    velocity_bias_m_s: Annotated[
        NonNegative, Field(le=100.0, description="error of the inertial velocity, common to a descent's intervals")
    ] = 5.0
    velocity_noise_m_s: Annotated[
        NonNegative, Field(le=100.0, description="error of the mean velocity over an interval, new in each")
    ] = 0.05
    image_time_offset_s: Annotated[
        float, Field(ge=-1.0, le=1.0, description="tagged less true time of exposure, the same in every picture")
    ] = 0.0
    image_time_jitter_s: Annotated[NonNegative, Field(le=1.0, description="spread of tagged less true time")] = 0.0005


@dataclass(frozen=True)
class Navigation:
    """The errors of one descent's navigation, drawn once; noise is drawn with every measurement."""

    parameters: NavigationParameters
    attitude_bias_rad: Float64[np.ndarray, "3"]
    velocity_bias_m_s: Float64[np.ndarray, "3"]

    @classmethod
    def drawn(cls, parameters: NavigationParameters, rng: np.random.Generator) -> Navigation:
        """Navigation with its constant errors drawn from this stream."""
        return cls(
            parameters,
            np.radians(parameters.attitude_bias_deg) * rng.standard_normal(3),
            parameters.velocity_bias_m_s * rng.standard_normal(3),
        )

    def tag(self, time_s: float, rng: np.random.Generator) -> float:
        """Time tag of a picture exposed at this true time."""
        p = self.parameters
        return time_s + p.image_time_offset_s + p.image_time_jitter_s * float(rng.standard_normal())

    def attitude(self, true: Rotation, time_s: float, rng: np.random.Generator) -> AttitudeMeasurement:
        """The attitude measured when it truly is `true`; its errors are small rotations about the world axes."""
        noise = np.radians(self.parameters.attitude_noise_deg) * rng.standard_normal(3)
        return AttitudeMeasurement(Rotation.from_rotvec(self.attitude_bias_rad + noise) * true, time_s)

    def velocity(self, true_m_s: Float64[np.ndarray, "3"], rng: np.random.Generator) -> Float64[np.ndarray, "3"]:
        """The mean velocity over an interval as inertial navigation has it, world axes."""
        noise = self.parameters.velocity_noise_m_s * rng.standard_normal(3)
        measured: Float64[np.ndarray, "3"] = true_m_s + self.velocity_bias_m_s + noise
        return measured
