"""Parachute descent as a physical two-stage swing: the line cones below the parachute, the lander nods on its bridle.

The canopy, a mass m_c at r, carries a straight line without mass of its own, direction n (unit vector, downwards). On
it the backshell hangs as a point mass m_b at L_b, and the lander at its end, at L. The lander is a rigid body, hinged
at the end of its bridle; its axis e (unit vector) runs from the hinge through its centre of mass, at d, to the camera,
at `arm_length_m`. It is axially symmetric: I_t across and I_a along its axis. The line stays straight because the
lander, three quarters of the mass, pulls it taut; swings of the backshell within it are left out.

Unit vectors are coordinates without singularity, for cones through nadir as for nods of any size. With M the whole
mass, S = m_b L_b + m_l L, J = m_b L_b^2 + m_l L^2 and P_x the part across x, Lagrange's equations are

    M r'' + S n'' + m_l d e'' = M g + F                                                                        (1)
    P_n (S (r'' - g) + J n'' + m_l d L e'') = c s x n                                                          (2)
    P_e (m_l d (r'' - g) + m_l d L n'' + (I_t + m_l d^2) e'') + I_a w e' x e = -c s x e                        (3)

    I_a w' = -c s e                                                                                            (4)

g downwards, w the lander's spin about its axis, s = P_n (e x e' + w e) - n x n' its rate against the line, which rolls
with it, damped by c in the bridle. (1) gives r''; (2) and (3) are then two equations for n'' and e'', solved in closed
form (`marsyard.sim.dynamics.kernels.swing`). F is the air's force on the canopy, at velocity v through it,

    F = -rho/2 A |v| (C_T |v| n + C_N P_n v),      rho falling off exponentially with height:

a tangential coefficient that does not change with the angle of attack, and a small restoring normal force, as befits
disk-gap-band parachutes near their trim angle (wind-tunnel tests: Cruz et al., AIAA 2003-2129); the size of the normal
force is set by the damping below, and so assumed. The air's force on backshell and lander, of a few per cent, is part
of the canopy's. rho A C_T is such that the canopy falls at the rate asked for in equilibrium with density and swing:
density, area and coefficient are dispersed by that rate alone.

C_N makes the coning. With k the normal force per angle of attack, mu = M - S^2 / J (the lander fixed to the line, and
so in S and J), kappa = k / mu, l = J / S, a = |F| / M and V the descent rate, small swings of the tilt obey

    (p + kappa / V) (p^2 + kappa / l) = kappa (kappa - a) / (V l).

At kappa = a the canopy falls straight and the line swings below it as a pendulum of length l, undamped. A greater kappa
damps, with the ratio (kappa - a) / (2 V omega), omega^2 = kappa / l; with a smaller one the coning grows.
`cone_damping_ratio` sets kappa.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from marsyard.sim.dynamics.chain import Modes, SwingParameters, chain_of
from marsyard.sim.dynamics.integration import Path, StateVector
from marsyard.sim.dynamics.kernels.swing import AXIS, CANOPY, LINE, Chain, truth
from marsyard.sim.dynamics.trajectory import Motion, Trajectory
from marsyard.sim.dynamics.wind import Wind

Vector = Float64[np.ndarray, "3"]

#: The flight is followed until the camera is this far below the thrusters' firing, m, for more than a second.
BEYOND_FIRING_M = 90.0
#: Followed backwards, what is damped grows: a nod of 60 deg/s to twice that in half a minute.
LONGEST_LEAD_S = 30.0
DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True)
class SwingDescent(Trajectory):
    """A descent through a place; a `Trajectory`.

    The body's origin is the camera, with the IMU beside it. At zero time, the first picture's nominal time, it is where
    it was asked to be, on a cone and in a nod of the phases asked for, with the canopy drifting with the mean wind;
    before and after, the equations of motion rule, and gusts act. Phases, amplitudes and rates are exact where the line
    or the lander swings alone and the air is still; large cones and nods together disturb one another a little.

    Attributes
    ----------
    parameters
        The descent.
    start_m
        World position of the camera at time 0.
    wind
        The wind met.
    ground_height_m
        The world's z of the ground, from which altitudes count.
    chain
        Constants of the equations of motion.
    path
        The states flown through.
    """

    parameters: SwingParameters
    start_m: Vector
    wind: Wind
    ground_height_m: float
    chain: Chain
    path: Path

    @classmethod
    def flown(
        cls,
        parameters: SwingParameters,
        start_m: Vector,
        rng: np.random.Generator,
        *,
        ground_height_m: float,
        gravity_m_s2: float = 3.72,
        lead_s: float = 10.0,
    ) -> SwingDescent:
        """The flight from `lead_s` before the first picture until more than a second after the thrusters' firing.

        Parameters
        ----------
        parameters
            The descent. Its `altitude_first_m` is for those who choose `start_m`; it is not read here.
        start_m
            World position of the camera at time 0, metres.
        rng
            Draws the gusts.
        ground_height_m
            The world's z of the ground below the first picture, metres.
        gravity_m_s2
            Acceleration of gravity.
        lead_s
            How long before the first picture the flight is known, up to `LONGEST_LEAD_S`.

        Raises
        ------
        ValueError
            If the start is not above the height of the thrusters' firing, the nod's rate would turn the lander over, or
            the lead is not allowed.
        """
        p = parameters
        if not 0.0 < lead_s <= LONGEST_LEAD_S:
            raise ValueError(f"lead_s is {lead_s:.6g}; allowed: above 0, up to {LONGEST_LEAD_S:.6g} s")
        lowest = ground_height_m + p.thruster_firing_m
        if start_m[2] <= lowest:
            raise ValueError(
                f"start_m is at z = {start_m[2]:.1f} m; allowed: above the thrusters' firing, {lowest:.1f} m"
            )
        wind = Wind.drawn(p, ground_height_m, rng)
        modes = Modes.of(p, gravity_m_s2)
        loop_deg_s = float(np.degrees(2.0 * modes.nod_rad_s))
        if p.nod_rate_deg_s >= loop_deg_s:
            raise ValueError(f"nod_rate_deg_s is {p.nod_rate_deg_s:.6g}; allowed: below {loop_deg_s:.6g}, a full loop")
        state = _started(p, modes, wind, start_m)
        chain = chain_of(p, modes, gravity_m_s2, float(state[CANOPY + 2]))

        def height_left(_t: float, y: StateVector, *_constants: Float64[np.ndarray, "..."]) -> float:
            return _camera_height(y, chain) - lowest + BEYOND_FIRING_M

        longest_s = 3.0 * (start_m[2] - ground_height_m) / p.descent_rate_m_s
        path = Path.followed(state, lead_s, longest_s, height_left, chain, wind.field)
        return cls(p, start_m, wind, ground_height_m, chain, path)

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time at which the flight is known."""
        return self.path.span_s

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """Truth at many times. Raises ValueError outside of the span."""
        positions, velocities, matrices, rates, forces = truth(self.path.at(times_s), self.chain, self.wind.field)
        return Motion(times_s, positions, velocities, Rotation.from_matrix(matrices, assume_valid=True), rates, forces)

    def time_of_altitude(self, altitude_m: float) -> float:
        """When the camera passes an altitude above `ground_height_m`. Raises ValueError if it does not in the span."""
        first, last = self.span_s

        def excess(time_s: float) -> float:
            return _camera_height(self.path.at(np.array([time_s]))[0], self.chain) - self.ground_height_m - altitude_m

        if not excess(last) <= 0.0 <= excess(first):
            highest, lowest = altitude_m + excess(first), altitude_m + excess(last)
            raise ValueError(
                f"altitude {altitude_m:.6g} m is not flown through; allowed: {lowest:.6g} to {highest:.6g} m"
            )
        return float(brentq(excess, first, last, xtol=1e-9))

    @cached_property
    def thruster_firing_s(self) -> float:
        """When the thrusters fire: at `thruster_firing_m` above the ground."""
        return self.time_of_altitude(self.parameters.thruster_firing_m)


def _camera_height(y: StateVector, chain: Chain) -> float:
    return float(y[CANOPY + 2] + chain.line_m * y[LINE + 2] + chain.reach_m * y[AXIS + 2])


def _started(p: SwingParameters, modes: Modes, wind: Wind, start_m: Vector) -> StateVector:
    """State at the first picture: the cone and the nod laid over a canopy that drifts with the mean wind."""
    line, line_rate = _coning(p, modes, 1.0)
    axis, axis_rate = _coning(p, modes, modes.lander_share)
    # a pendulum of any amplitude, about an axis that goes with the cone: sin(angle / 2) and rate are in quadrature
    phase, greatest_rate = np.radians(p.nod_phase_deg), np.radians(p.nod_rate_deg_s)
    nod = 2.0 * np.arcsin(greatest_rate / (2.0 * modes.nod_rad_s) * np.sin(phase))
    nod_rate = greatest_rate * np.cos(phase)
    about = _across(_tilt_axis(np.radians(p.cone_direction_deg + p.nod_direction_deg)), axis)
    about_line = _across(about, line)
    recoil = modes.canopy_recoil_m * nod_rate * np.cross(about, axis)
    # where coning is damped, the canopy does not quite fall straight: r'' = (kappa - a) tilt, harmonic
    lag = -2.0 * p.cone_damping_ratio * p.descent_rate_m_s / modes.cone_rad_s * line_rate * np.array([1.0, 1.0, 0.0])
    axis_turn = np.cross(axis, axis_rate) + nod_rate * about
    line_turn = np.cross(line, line_rate) + modes.line_recoil * nod_rate * about_line
    axis = Rotation.from_rotvec(nod * about).apply(axis)
    line = Rotation.from_rotvec(modes.line_recoil * nod * about_line).apply(line)
    canopy = start_m - p.line_length_m * line - p.arm_length_m * axis
    drift = wind.without_gusts.velocities(canopy[2:])[0]
    # the least rotation that turns the body's downward axis to the lander's, after one about it by the heading
    upright = Rotation.from_quat(np.append(np.cross(DOWN, axis), 1.0 + DOWN @ axis))
    side = (upright * Rotation.from_rotvec(np.radians(p.heading_deg) * DOWN)).apply(np.array([1.0, 0.0, 0.0]))
    return np.concatenate(
        [
            canopy,
            drift + p.descent_rate_m_s * DOWN + recoil + lag,
            line,
            np.cross(line_turn, line),
            axis,
            np.cross(axis_turn, axis),
            side,
            [np.radians(p.spin_rate_deg_s)],
        ]
    )


def _coning(p: SwingParameters, modes: Modes, share: float) -> tuple[Vector, Vector]:
    """Direction of what tilts by a share of the line's tilt, and its rate of change, at the first picture.

    The line is a spherical pendulum between its greatest and least tilt, of cosines z_0 and z_1. With angular frequency
    w_0 of small swings, Lz the angular momentum about the vertical per moment of inertia, and z the cosine of the tilt,

        z'^2 = 2 w_0^2 (z - z_0) (z_1 - z) (z - z_2),   z_2 = -(1 + z_0 z_1) / (z_0 + z_1),
        Lz^2 = 2 w_0^2 sin^2(tilt_0) sin^2(tilt_1) / (z_0 + z_1)

    (Landau & Lifshitz, Mechanics, 14). The phase places it on the ellipse that the tilts of small swings describe.
    """
    if p.cone_angle_deg == 0.0:
        return DOWN, np.zeros(3)
    greatest, phase = np.radians(p.cone_angle_deg) / modes.lander_share, np.radians(p.cone_phase_deg)
    least = greatest * p.cone_minor_share
    azimuth = np.radians(p.cone_direction_deg)
    major = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
    minor = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
    tilted = greatest * np.cos(phase) * major + least * np.sin(phase) * minor
    # never zero for a cone that is not: the cosine of no floating-point phase is
    tilt = float(np.linalg.norm(tilted))
    towards = tilted / tilt
    round_ = np.cross(DOWN, towards)
    z0, z1, z = np.cos(greatest), np.cos(least), np.cos(tilt)
    above_least = 2.0 * (np.sin(0.5 * greatest) ** 2 - np.sin(0.5 * tilt) ** 2)
    below_most = 2.0 * (np.sin(0.5 * tilt) ** 2 - np.sin(0.5 * least) ** 2)
    level = (above_least * below_most) * (z + (1.0 + z0 * z1) / (z0 + z1))
    tilt_rate = -np.sign(np.sin(2.0 * phase)) * modes.cone_rad_s * np.sqrt(2.0 * max(level, 0.0)) / np.sin(tilt)
    round_speed = modes.cone_rad_s * np.sqrt(2.0 / (z0 + z1)) * np.sin(greatest) * np.sin(least) / np.sin(tilt)
    inclined = share * tilt
    direction = np.sin(inclined) * towards + np.cos(inclined) * DOWN
    rate = share * tilt_rate * (np.cos(inclined) * towards - np.sin(inclined) * DOWN)
    return direction, rate + np.sin(inclined) / np.sin(tilt) * round_speed * round_


def _tilt_axis(azimuth_rad: float) -> Vector:
    """Axis of the rotation that tilts nadir towards an azimuth (clockwise from north)."""
    # nadir x towards: (0, 0, -1) x (sin a, cos a, 0) = (cos a, -sin a, 0)
    return np.array([np.cos(azimuth_rad), -np.sin(azimuth_rad), 0.0])


def _across(vector: Vector, direction: Vector) -> Vector:
    """Unit vector of the part of a vector across a direction."""
    part = vector - (vector @ direction) * direction
    return np.asarray(part / np.linalg.norm(part))
