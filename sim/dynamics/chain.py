"""The hanging chain of canopy, backshell and lander: its parameters, its constants and its linear theory.

`marsyard.sim.dynamics.swing` has the equations and says what the symbols mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from marsyard.sim.dynamics.kernels.swing import Chain
from marsyard.sim.dynamics.wind import WindParameters

#: Greatest tilt of a coning lander over the line's tilt for which the start of a flight is known well enough.
MOST_LANDER_SHARE = 1.5
Phase = Annotated[float, Field(ge=-360.0, le=720.0)]


class SwingParameters(WindParameters):
    """A descent. Angles in degrees, as in campaign files; altitudes above the ground below the first picture.

    Masses are those of the Mars Exploration Rovers (NASA press kit, January 2004: lander with rover 533 kg, backshell
    with parachute 209 kg), as is the bridle of 20 m; what is marked "assumed" is not published or was not looked up.
    """

    altitude_first_m: Annotated[float, Field(gt=100.0, le=10000.0, description="altitude of the first picture, m")] = (
        2000.0
    )
    interval_s: Annotated[float, Field(gt=0.1, le=60.0, description="time between pictures, s")] = 3.75
    descent_rate_m_s: Annotated[
        float, Field(ge=20.0, le=200.0, description="the canopy's descent rate at the first picture, m/s")
    ] = 75.0
    density_scale_height_m: Annotated[
        float, Field(ge=5000.0, le=20000.0, description="height over which density falls to 1/e, m; CO2 at 220 K")
    ] = 11200.0
    cone_angle_deg: Annotated[
        float, Field(ge=0.0, le=45.0, description="greatest angle of the coning lander from nadir, but for its nods")
    ] = 15.0
    cone_minor_share: Annotated[
        float, Field(ge=-1.0, le=1.0, description="smaller over greater half-axis of the cone; the sign is its sense")
    ] = 0.5
    cone_direction_deg: Annotated[Phase, Field(description="azimuth of the cone's greater axis")] = 0.0
    cone_phase_deg: Annotated[Phase, Field(description="phase of the coning at the first picture")] = 0.0
    cone_damping_ratio: Annotated[
        float, Field(ge=-0.05, le=0.2, description="damping of small coning over critical; assumed")
    ] = 0.01
    nod_rate_deg_s: Annotated[float, Field(ge=0.0, le=120.0, description="greatest rate of the nodding")] = 20.0
    nod_direction_deg: Annotated[Phase, Field(description="azimuth of the nodding, relative to the cone's axis")] = 0.0
    nod_phase_deg: Annotated[Phase, Field(description="phase of the nodding at the first picture")] = 0.0
    nod_damping_ratio: Annotated[
        float, Field(ge=0.0, le=0.5, description="the bridle's damping of small nodding over critical; assumed")
    ] = 0.002
    heading_deg: Annotated[Phase, Field(description="rotation about the lander's axis at the first picture")] = 0.0
    spin_rate_deg_s: Annotated[
        float, Field(ge=-30.0, le=30.0, description="rate about the axis at the first picture")
    ] = 0.0
    line_length_m: Annotated[
        float,
        Field(ge=10.0, le=200.0, description="from the canopy to the lander's hinge, m; bridle 20 m, rest assumed"),
    ] = 47.0
    bridle_length_m: Annotated[float, Field(ge=1.0, le=100.0, description="from the backshell to the hinge, m")] = 20.0
    canopy_mass_kg: Annotated[
        float, Field(ge=1.0, le=1000.0, description="canopy, lines and the air that moves with it, kg; assumed")
    ] = 30.0
    backshell_mass_kg: Annotated[float, Field(ge=0.0, le=5000.0, description="backshell without canopy, kg")] = 179.0
    lander_mass_kg: Annotated[float, Field(ge=1.0, le=5000.0, description="lander with rover, kg")] = 533.0
    mass_centre_m: Annotated[
        float, Field(ge=0.1, le=10.0, description="from the hinge to the lander's centre of mass, m; assumed")
    ] = 1.5
    gyration_transverse_m: Annotated[
        float, Field(ge=0.05, le=5.0, description="radius of gyration across the lander's axis, m; assumed")
    ] = 0.5
    gyration_axial_m: Annotated[
        float, Field(ge=0.05, le=5.0, description="radius of gyration about the lander's axis, m; assumed")
    ] = 0.5
    arm_length_m: Annotated[float, Field(ge=0.0, le=10.0, description="from the hinge to the camera, m; assumed")] = 1.5
    thruster_firing_m: Annotated[
        float, Field(ge=0.0, le=1000.0, description="height above ground of the thrusters' firing, m")
    ] = 100.0

    @model_validator(mode="after")
    def _bridle_is_part_of_line(self) -> SwingParameters:
        if self.bridle_length_m > self.line_length_m:
            raise ValueError(
                f"bridle_length_m is {self.bridle_length_m:.6g}; allowed: up to line_length_m, {self.line_length_m:.6g}"
            )
        return self


@dataclass(frozen=True)
class Modes:
    """The linear theory of the hanging chain, from which flights are started.

    Attributes
    ----------
    support_m_s2
        The air's force over mass in the mean of a swing: gravity, and the braking in ever denser air.
    cone_rad_s, nod_rad_s
        Undamped angular frequencies.
    lander_share
        The lander's tilt over the line's while coning.
    line_recoil, canopy_recoil_m
        The line's tilt and the canopy's displacement per tilt of the lander while nodding.
    normal_force_n
        Normal force on the canopy per radian of angle of attack.
    hinge_damping
        Torque per rate in the bridle, N m s. The canopy's drag damps nodding too, by about 0.003 of critical.
    """

    support_m_s2: float
    cone_rad_s: float
    nod_rad_s: float
    lander_share: float
    line_recoil: float
    canopy_recoil_m: float
    normal_force_n: float
    hinge_damping: float

    @classmethod
    def of(cls, p: SwingParameters, gravity_m_s2: float) -> Modes:
        """Modes of the parameters' chain. Raises ValueError if its lander does not nod far faster than it cones."""
        mass, lander = _mass(p), p.lander_mass_kg * p.mass_centre_m
        first, second = _moments(p, p.line_length_m)
        support = gravity_m_s2 + p.descent_rate_m_s**2 / (2.0 * p.density_scale_height_m)
        rigid_first, rigid_second = _moments(p, p.line_length_m + p.mass_centre_m)
        rigid_second += _transverse_inertia(p)
        length = rigid_second / rigid_first
        # kappa = a + 2 ratio V omega and kappa = l omega^2: see the module's text
        damping = p.cone_damping_ratio * p.descent_rate_m_s
        cone = (damping + np.sqrt(damping**2 + support * length)) / length
        normal = (mass - rigid_first**2 / rigid_second) * length * cone**2
        # moments about the canopy's free motion: A of the line, B of the lander, C of both
        a = second - first**2 / mass
        c = lander * (p.line_length_m - first / mass)
        b = _transverse_inertia(p) + lander * (p.mass_centre_m - lander / mass)
        nod = np.sqrt(lander * support * (1.0 + c / a) / (b - c**2 / a))
        # the lander follows the line's tilt as far as its own swing is fast beside the line's
        share = (lander * (support - normal / mass) + c * cone**2) / (lander * support - b * cone**2)
        if not 0.0 < share <= MOST_LANDER_SHARE:
            raise ValueError(
                f"gyration_transverse_m of {p.gyration_transverse_m:.6g} with mass_centre_m of {p.mass_centre_m:.6g} "
                f"makes the lander nod in {2.0 * np.pi / nod:.3g} s, and it cones in {2.0 * np.pi / cone:.3g} s; "
                "allowed: nods far faster than cones"
            )
        return cls(
            support_m_s2=float(support),
            cone_rad_s=float(cone),
            nod_rad_s=float(nod),
            lander_share=float(share),
            line_recoil=float(-c / a),
            canopy_recoil_m=float((first * c / a - lander) / mass),
            normal_force_n=float(normal),
            hinge_damping=float(2.0 * p.nod_damping_ratio * nod * (b - c**2 / a) / (1.0 + c / a) ** 2),
        )


def _mass(p: SwingParameters) -> float:
    return p.canopy_mass_kg + p.backshell_mass_kg + p.lander_mass_kg


def _moments(p: SwingParameters, lander_at_m: float) -> tuple[float, float]:
    """First and second moment of mass about the canopy, with the lander's mass at a distance."""
    backshell_at = p.line_length_m - p.bridle_length_m
    first = p.backshell_mass_kg * backshell_at + p.lander_mass_kg * lander_at_m
    return first, p.backshell_mass_kg * backshell_at**2 + p.lander_mass_kg * lander_at_m**2


def _transverse_inertia(p: SwingParameters) -> float:
    return p.lander_mass_kg * p.gyration_transverse_m**2


def chain_of(p: SwingParameters, modes: Modes, gravity_m_s2: float, canopy_height_m: float) -> Chain:
    """Constants of the equations of motion, for a canopy at a height of the world's z at the first picture."""
    first, second = _moments(p, p.line_length_m)
    greatest = np.radians(p.cone_angle_deg) / modes.lander_share
    # the air holds the weight with the vertical part of its force: of its mean over the cone
    upright = np.cos(greatest * np.sqrt(0.5 * (1.0 + p.cone_minor_share**2)))
    tangential = _mass(p) * modes.support_m_s2 / (upright * p.descent_rate_m_s**2)
    return Chain(
        mass_kg=_mass(p),
        lander_mass_kg=p.lander_mass_kg,
        first_moment=first,
        second_moment=second,
        line_m=p.line_length_m,
        mass_centre_m=p.mass_centre_m,
        reach_m=p.arm_length_m,
        transverse_inertia=_transverse_inertia(p),
        axial_inertia=p.lander_mass_kg * p.gyration_axial_m**2,
        hinge_damping=modes.hinge_damping,
        tangential=float(tangential),
        normal=modes.normal_force_n / p.descent_rate_m_s**2,
        reference_height_m=canopy_height_m,
        scale_height_m=p.density_scale_height_m,
        gravity_m_s2=gravity_m_s2,
    )
