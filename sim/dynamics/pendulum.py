"""Parameters of the two-stage pendulum of `marsyard.sim.dynamics.swing`, its modes, and the constants of its motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from marsyard.sim.dynamics.kernels.swing import Chain
from marsyard.sim.dynamics.wind import WindParameters
from marsyard.sim.error_sources import SWING
from marsyard.sim.parameters import bounded_field

Degrees = Annotated[float, Field(ge=-360.0, le=720.0)]
Gyration = Annotated[float, Field(ge=0.05, le=5.0)]
#: Maximum ratio of the coning lander's tilt to the line's for which the linear theory defines an initial state.
MAX_LANDER_TILT_RATIO = 1.5


class SwingParameters(WindParameters):
    """Parameters of a parachute descent. Altitudes are above the ground below the position of the first image.

    Masses and bridle length are those of the Mars Exploration Rovers (NASA press kit, January 2004: lander with rover
    533 kg, backshell with parachute 209 kg, bridle 20 m). Values marked "assumed" are not published.
    """

    altitude_first_m: Annotated[float, Field(gt=100.0, le=10000.0, description="altitude of the first image")] = 2000.0
    interval_s: Annotated[float, Field(gt=0.1, le=60.0, description="time between images")] = 3.75
    descent_rate_m_s: Annotated[
        float, bounded_field(20.0, 200.0, "descent rate of the parachute at the first image")
    ] = 75.0
    density_scale_height_m: Annotated[float, bounded_field(5000.0, 20000.0, "density scale height: CO2 at 220 K")] = (
        11200.0
    )
    cone_angle_deg: Annotated[
        float, SWING, bounded_field(0.0, 45.0, "largest angle between the lander's axis and nadir")
    ] = 15.0
    cone_minor_fraction: Annotated[
        float, bounded_field(-1.0, 1.0, "minor / major axis of the coning; sign: sense of rotation")
    ] = 0.5
    cone_direction_deg: Annotated[Degrees, Field(description="azimuth of the major axis of the coning")] = 0.0
    cone_phase_deg: Annotated[Degrees, Field(description="phase of the coning at the first image")] = 0.0
    cone_damping_ratio: Annotated[float, bounded_field(-0.05, 0.2, "damping of small coning / critical (assumed)")] = (
        0.01
    )
    nod_rate_deg_s: Annotated[
        float, SWING, bounded_field(0.0, 120.0, "largest rate of the nodding: fast swing of the lander on its bridle")
    ] = 20.0
    nod_direction_deg: Annotated[
        Degrees, Field(description="azimuth of the nodding, relative to the coning's major axis")
    ] = 0.0
    nod_phase_deg: Annotated[Degrees, Field(description="phase of the nodding at the first image")] = 0.0
    nod_damping_ratio: Annotated[float, bounded_field(0.0, 0.5, "damping of small nodding / critical (assumed)")] = (
        0.002
    )
    heading_deg: Annotated[Degrees, Field(description="rotation about the lander's axis at the first image")] = 0.0
    spin_rate_deg_s: Annotated[
        float, SWING, bounded_field(-30.0, 30.0, "spin rate about the lander's axis at the first image")
    ] = 0.0
    line_length_m: Annotated[float, bounded_field(10.0, 200.0, "canopy to hinge; bridle 20 m, rest assumed")] = 47.0
    bridle_length_m: Annotated[float, bounded_field(1.0, 100.0, "from the backshell to the hinge")] = 20.0
    canopy_mass_kg: Annotated[float, bounded_field(1.0, 1000.0, "canopy, lines and entrained air (assumed)")] = 30.0
    backshell_mass_kg: Annotated[float, bounded_field(0.0, 5000.0, "backshell without canopy")] = 179.0
    lander_mass_kg: Annotated[float, bounded_field(1.0, 5000.0, "lander with rover")] = 533.0
    mass_centre_m: Annotated[float, bounded_field(0.1, 10.0, "hinge to the lander's centre of mass (assumed)")] = 1.5
    gyration_transverse_m: Annotated[Gyration, Field(description="radius of gyration across the axis (assumed)")] = 0.5
    gyration_axial_m: Annotated[Gyration, Field(description="radius of gyration about the axis (assumed)")] = 0.5
    arm_length_m: Annotated[float, bounded_field(0.0, 10.0, "from the hinge to the camera (assumed)")] = 1.5
    thruster_firing_m: Annotated[float, bounded_field(0.0, 1000.0, "height above ground of the thrusters' firing")] = (
        100.0
    )

    @model_validator(mode="after")
    def _check_bridle(self) -> SwingParameters:
        if self.bridle_length_m > self.line_length_m:
            raise ValueError(
                f"bridle_length_m is {self.bridle_length_m:.6g}; allowed: up to line_length_m, {self.line_length_m:.6g}"
            )
        return self

    @property
    def _mass_kg(self) -> float:
        return self.canopy_mass_kg + self.backshell_mass_kg + self.lander_mass_kg

    def _moments(self, lander_m: float) -> tuple[float, float]:
        """Compute the first and second moment of mass about the canopy for the lander's distance from the canopy."""
        backshell_m = self.line_length_m - self.bridle_length_m
        first = self.backshell_mass_kg * backshell_m + self.lander_mass_kg * lander_m
        return first, self.backshell_mass_kg * backshell_m**2 + self.lander_mass_kg * lander_m**2


@dataclass(frozen=True)
class Modes:
    """Linear coning and nodding modes of the hanging chain, from which a descent's initial state is computed.

    - support_m_s2: mean force of the air / mass: gravity plus the deceleration in air of increasing density
    - cone_rad_s, nod_rad_s: undamped angular frequencies of coning and nodding
    - lander_tilt_ratio: tilt of the lander / tilt of the line during coning
    - line_recoil, canopy_recoil_m: tilt of the line and displacement of the canopy / tilt of the nodding lander
    - normal_force_n: normal force on the canopy per radian of angle of attack
    - hinge_damping: damping c in the bridle, N m s; the canopy's drag adds about 0.003 of critical damping
    """

    support_m_s2: float
    cone_rad_s: float
    nod_rad_s: float
    lander_tilt_ratio: float
    line_recoil: float
    canopy_recoil_m: float
    normal_force_n: float
    hinge_damping: float

    @classmethod
    def from_parameters(cls, p: SwingParameters, gravity_m_s2: float) -> Modes:
        """Compute the modes. Raises ValueError unless the nodding is much faster than the coning."""
        mass, lander_moment = p._mass_kg, p.lander_mass_kg * p.mass_centre_m
        inertia = p.lander_mass_kg * p.gyration_transverse_m**2
        first, second = p._moments(p.line_length_m)
        support = gravity_m_s2 + p.descent_rate_m_s**2 / (2.0 * p.density_scale_height_m)
        rigid_first, rigid_second = p._moments(p.line_length_m + p.mass_centre_m)
        rigid_second += inertia
        length = rigid_second / rigid_first
        # kappa = a + 2 ratio V omega and kappa = l omega^2: see the docstring of `swing`
        damping = p.cone_damping_ratio * p.descent_rate_m_s
        cone = (damping + np.sqrt(damping**2 + support * length)) / length
        normal = (mass - rigid_first**2 / rigid_second) * length * cone**2
        # coefficients of n'' and e'' in (2) and (3) after r'' is eliminated: A n'' + C e'', C n'' + B e''
        a = second - first**2 / mass
        c = lander_moment * (p.line_length_m - first / mass)
        b = inertia + lander_moment * (p.mass_centre_m - lander_moment / mass)
        nod = np.sqrt(lander_moment * support * (1.0 + c / a) / (b - c**2 / a))
        # forced response of the lander's pendulum to the line's coning
        tilt_ratio = (lander_moment * (support - normal / mass) + c * cone**2) / (lander_moment * support - b * cone**2)
        if not 0.0 < tilt_ratio <= MAX_LANDER_TILT_RATIO:
            raise ValueError(
                f"gyration_transverse_m of {p.gyration_transverse_m:.6g} with mass_centre_m of {p.mass_centre_m:.6g} "
                f"leads to nodding with a period of {2.0 * np.pi / nod:.3g} s and coning with one of "
                f"{2.0 * np.pi / cone:.3g} s; allowed: nodding much faster than coning"
            )
        return cls(
            support_m_s2=float(support),
            cone_rad_s=float(cone),
            nod_rad_s=float(nod),
            lander_tilt_ratio=float(tilt_ratio),
            line_recoil=float(-c / a),
            canopy_recoil_m=float((first * c / a - lander_moment) / mass),
            normal_force_n=float(normal),
            hinge_damping=float(2.0 * p.nod_damping_ratio * nod * (b - c**2 / a) / (1.0 + c / a) ** 2),
        )


def build_chain(p: SwingParameters, modes: Modes, gravity_m_s2: float, canopy_height_m: float) -> Chain:
    """Compute the constants of the equations of motion; `canopy_height_m`: the canopy's world z at the first image."""
    first, second = p._moments(p.line_length_m)
    largest_rad = np.radians(p.cone_angle_deg) / modes.lander_tilt_ratio
    # the vertical component of the air's force, averaged over a turn of the cone, balances the weight
    vertical_fraction = np.cos(largest_rad * np.sqrt(0.5 * (1.0 + p.cone_minor_fraction**2)))
    tangential = p._mass_kg * modes.support_m_s2 / (vertical_fraction * p.descent_rate_m_s**2)
    return Chain(
        **p.model_dump(include=set(Chain._fields)),
        mass_kg=p._mass_kg,
        first_moment=first,
        second_moment=second,
        line_m=p.line_length_m,
        camera_m=p.arm_length_m,
        transverse_inertia=p.lander_mass_kg * p.gyration_transverse_m**2,
        axial_inertia=p.lander_mass_kg * p.gyration_axial_m**2,
        hinge_damping=modes.hinge_damping,
        tangential=float(tangential),
        normal=modes.normal_force_n / p.descent_rate_m_s**2,
        reference_height_m=canopy_height_m,
        scale_height_m=p.density_scale_height_m,
        gravity_m_s2=gravity_m_s2,
    )
