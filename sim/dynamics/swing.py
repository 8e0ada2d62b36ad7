"""Parachute descent as a two-stage pendulum: the line cones below the canopy, and the lander nods on its bridle.

The canopy is a point mass m_c at r. Below it is a massless straight line with direction n (unit vector, downwards). The
backshell is a point mass m_b on the line at the distance L_b from the canopy. The lander is a rigid body of mass m_l,
hinged at the end of the line, at L. The line between backshell and lander is the bridle. The lander's axis e (unit
vector) points from the hinge through its centre of mass, at d, to the camera, at `arm_length_m`. The lander is axially
symmetric, with the moments of inertia I_t across and I_a along the axis. The line is always straight. With the total
mass M, S = m_b L_b + m_l L, J = m_b L_b^2 + m_l L^2 and the projection P_x perpendicular to x, Lagrange's equations are

    M r'' + S n'' + m_l d e'' = M g + F                                                                        (1)
    P_n (S (r'' - g) + J n'' + m_l d L e'') = c s x n                                                          (2)
    P_e (m_l d (r'' - g) + m_l d L n'' + (I_t + m_l d^2) e'') + I_a w e' x e = -c s x e                        (3)

    I_a w' = -c s e                                                                                            (4)

where g is the gravity vector, w the lander's spin about its axis, s = P_n (e x e' + w e) - n x n' the lander's angular
rate relative to the line, and c the damping in the bridle; the line has the lander's roll rate. With r'' from (1), (2)
and (3) are two equations for n'' and e'', solved in closed form (`marsyard.sim.dynamics.kernels.swing`). The force of
the air on the canopy, at the velocity v relative to the air, is::

    F = -rho/2 A |v| (C_T |v| n + C_N P_n v),      rho decreasing exponentially with height.

C_T is independent of the angle of attack, and C_N is a small restoring normal force, as for disk-gap-band parachutes
near their trim angle (wind-tunnel tests: Cruz et al., AIAA 2003-2129). C_N follows from the assumed damping of the
coning. F includes the force on backshell and lander, a few per cent. rho A C_T is chosen such that the canopy falls at
`descent_rate_m_s` in equilibrium; the dispersion of this rate stands for those of density, area and coefficient.

C_N causes the coning. Let the lander be fixed to the line, and included in S and J. With the normal force per angle of
attack k, mu = M - S^2 / J, kappa = k / mu, l = J / S, ``a = |F| / M`` and the descent rate V, the characteristic
equation (p: eigenvalue) of small swings is

    (p + kappa / V) (p^2 + kappa / l) = kappa (kappa - a) / (V l).

At kappa = a the canopy falls straight and the line swings below it as an undamped pendulum of length l. For a larger
kappa the coning is damped, with the ratio (kappa - a) / (2 V omega), omega^2 = kappa / l; for a smaller kappa it grows.
kappa is computed from `cone_damping_ratio`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from CyRK import PySolver, pysolve_ivp
from jaxtyping import Float64
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from marsyard.sim.dynamics.kernels import swing as kernels
from marsyard.sim.dynamics.kernels.swing import CANOPY, Chain
from marsyard.sim.dynamics.pendulum import Modes, SwingParameters, build_chain
from marsyard.sim.dynamics.trajectory import Motion, Trajectory, check_times
from marsyard.sim.dynamics.wind import Wind

Vector = Float64[np.ndarray, "3"]
StateVector = Float64[np.ndarray, "22"]
Constants = tuple[Float64[np.ndarray, "_"], Float64[np.ndarray, "_ 7"]]

#: Distance of the camera below the thrusters' firing height at which the integration ends: more than a second later.
BELOW_FIRING_M = 90.0
#: Maximum time of backward integration, in which damped swings grow: in 30 s a nod of 60 deg/s doubles its rate.
MAX_LEAD_S = 30.0
#: Relative and absolute tolerance of the integration: finite differences of the flight equal its derivatives to 1e-6.
TOLERANCE = 1e-9
#: Tolerance of the time at which an altitude is passed: 0.1 um at 100 m/s.
_ALTITUDE_TIME_TOLERANCE_S = 1e-9
#: Unit vector downwards, world axes.
DOWN = np.array([0.0, 0.0, -1.0])


@dataclass(frozen=True)
class SwingDescent(Trajectory):
    """Simulated parachute descent of a lander below a swinging line: a `Trajectory` of the camera.

    The origin of the body frame is the camera, and the IMU is at the same point. At time 0, the time of the first
    image, the camera is at `start_m`, coning and nodding have the phases of the parameters, and the canopy drifts with
    the mean wind. The equations of motion with gusts are integrated from this state backward and forward. Amplitudes
    and rates match the parameters for coning or nodding alone in still air; large coning and nodding interact.

    - parameters, start_m: parameters of the descent, and the camera's position at time 0, world axes, metres
    - wind: mean wind and gusts as functions of height
    - ground_height_m: world z of the ground, the reference of altitudes
    - chain: constants of the equations of motion
    - backward, forward: solutions of the equations from time 0, with CyRK's dense output
    """

    parameters: SwingParameters
    start_m: Vector
    wind: Wind
    ground_height_m: float
    chain: Chain
    backward: PySolver
    forward: PySolver

    @classmethod
    def simulate(
        cls,
        parameters: SwingParameters,
        start_m: Vector,
        rng: np.random.Generator,
        *,
        ground_height_m: float,
        gravity_m_s2: float,
        lead_s: float,
    ) -> SwingDescent:
        """Simulate from `lead_s` before the first image until more than a second after the thrusters' firing.

        `start_m` is the camera's position at time 0, world axes; `altitude_first_m` of the parameters is not used.
        `rng` draws the gusts. Raises ValueError if the start is below the height of the thrusters' firing, the nod rate
        would rotate the lander by a full turn, or `lead_s` is not above 0 and at most `MAX_LEAD_S`.
        """
        p = parameters
        if not 0.0 < lead_s <= MAX_LEAD_S:
            raise ValueError(f"lead_s is {lead_s:.6g}; allowed: above 0, up to {MAX_LEAD_S:.6g} s")
        firing_m = ground_height_m + p.thruster_firing_m
        if start_m[2] <= firing_m:
            raise ValueError(
                f"start_m is at z = {start_m[2]:.1f} m; allowed: above the thrusters' firing, {firing_m:.1f} m"
            )
        wind = Wind.draw(p, ground_height_m, rng)
        modes = Modes.from_parameters(p, gravity_m_s2)
        # with this rate at the lowest point the lander would reach the upright position
        loop_deg_s = float(np.degrees(2.0 * modes.nod_rad_s))
        if p.nod_rate_deg_s >= loop_deg_s:
            raise ValueError(f"nod_rate_deg_s is {p.nod_rate_deg_s:.6g}; allowed: below {loop_deg_s:.6g}, a full loop")
        state = _compute_initial_state(p, modes, wind, start_m)
        chain = build_chain(p, modes, gravity_m_s2, float(state[CANOPY + 2]))

        def remaining_height(_t: float, y: StateVector, *_constants: Float64[np.ndarray, "..."]) -> float:
            return _compute_camera_height(y, chain) - firing_m + BELOW_FIRING_M

        remaining_height.terminal = True  # type: ignore[attr-defined]
        # the fall takes about this height / rate; three times as long ends a flight that does not fall
        max_s = 3.0 * (start_m[2] - ground_height_m) / p.descent_rate_m_s
        constants = kernels.pack_constants(chain, wind.field)
        backward = _integrate(state, -lead_s, None, constants)
        forward = _integrate(state, max_s, (remaining_height,), constants)
        return cls(p, start_m, wind, ground_height_m, chain, backward, forward)

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time of the simulation."""
        return float(self.backward.t[-1]), float(self.forward.t[-1])

    def motion(self, times_s: Float64[np.ndarray, "n"]) -> Motion:
        """Compute the true states at many times. Raises ValueError for times outside the span."""
        truth = kernels.compute_truth(self._compute_states(times_s), self.chain, self.wind.field)
        attitudes = Rotation.from_matrix(truth.attitudes, assume_valid=True)
        return Motion(times_s, truth.positions, truth.velocities, attitudes, truth.body_rates, truth.specific_forces)

    def _compute_states(self, times_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 22"]:
        """Compute the state vectors (`kernels.swing`) at many times. Raises ValueError for times outside the span."""
        check_times(times_s, self.span_s)
        states = np.empty((times_s.size, kernels.SIZE))
        is_backward = times_s < 0.0
        for solution, selected in ((self.backward, is_backward), (self.forward, ~is_backward)):
            states[selected] = solution(times_s[selected]).T
        return states

    def time_of_altitude(self, altitude_m: float) -> float:
        """Return the time at which the camera passes an altitude above the ground; ValueError if it does not."""
        first, last = self.span_s

        def height_above(time_s: float) -> float:
            return (
                _compute_camera_height(self._compute_states(np.array([time_s]))[0], self.chain)
                - self.ground_height_m
                - altitude_m
            )

        if not height_above(last) <= 0.0 <= height_above(first):
            highest, lowest = altitude_m + height_above(first), altitude_m + height_above(last)
            raise ValueError(f"altitude {altitude_m:.6g} m is not passed; allowed: {lowest:.6g} to {highest:.6g} m")
        return float(brentq(height_above, first, last, xtol=_ALTITUDE_TIME_TOLERANCE_S))

    @cached_property
    def thruster_firing_s(self) -> float:
        """Time of the thrusters' firing, at `thruster_firing_m` above the ground."""
        return self.time_of_altitude(self.parameters.thruster_firing_m)


def _integrate(
    state: StateVector, end_s: float, events: tuple[Callable[..., float]] | None, constants: Constants
) -> PySolver:
    """Integrate from a state at time 0 to `end_s`, or until an event is zero that has the attribute `terminal`.

    `constants` are from `kernels.pack_constants`. Raises ValueError if the integration fails.
    """
    solution = pysolve_ivp(
        kernels.state_derivative,
        (0.0, end_s),
        state,
        method="DOP853",
        dense_output=True,
        rtol=TOLERANCE,
        atol=TOLERANCE,
        events=events,
        args=constants,
    )
    if not solution.success:
        raise ValueError(f"the integration of the descent fails at {solution.t[-1]:.6g} s: {solution.message}")
    return solution


def _compute_camera_height(y: StateVector, chain: Chain) -> float:
    return float(y[CANOPY + 2] + chain.line_m * y[kernels.LINE + 2] + chain.camera_m * y[kernels.AXIS + 2])


def _compute_initial_state(p: SwingParameters, modes: Modes, wind: Wind, start_m: Vector) -> StateVector:
    """Compute the state at the first image: coning and nodding of a canopy that drifts with the mean wind."""
    line, line_rate = _compute_cone_direction(p, modes, 1.0)
    axis, axis_rate = _compute_cone_direction(p, modes, modes.lander_tilt_ratio)
    # nodding about an axis that moves with the cone; the energy of a pendulum of any amplitude is constant:
    # rate^2 + (2 nod_rad_s sin(nod / 2))^2 = largest_rate^2
    phase, largest_rate = np.radians(p.nod_phase_deg), np.radians(p.nod_rate_deg_s)
    nod = 2.0 * np.arcsin(largest_rate / (2.0 * modes.nod_rad_s) * np.sin(phase))
    nod_rate = largest_rate * np.cos(phase)
    # axis of a tilt from nadir towards an azimuth: (0, 0, -1) x (sin a, cos a, 0)
    azimuth = np.radians(p.cone_direction_deg + p.nod_direction_deg)
    tilt_axis = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
    nod_axis = _perpendicular(tilt_axis, axis)
    line_axis = _perpendicular(nod_axis, line)
    recoil_velocity = modes.canopy_recoil_m * nod_rate * np.cross(nod_axis, axis)
    # with damped coning the canopy oscillates: r'' = (kappa - a) tilt
    coning_velocity = (
        -2.0 * p.cone_damping_ratio * p.descent_rate_m_s / modes.cone_rad_s * line_rate * np.array([1.0, 1.0, 0.0])
    )
    axis_rotation = np.cross(axis, axis_rate) + nod_rate * nod_axis
    line_rotation = np.cross(line, line_rate) + modes.line_recoil * nod_rate * line_axis
    axis = Rotation.from_rotvec(nod * nod_axis).apply(axis)
    line = Rotation.from_rotvec(modes.line_recoil * nod * line_axis).apply(line)
    canopy = start_m - p.line_length_m * line - p.arm_length_m * axis
    drift = wind.without_gusts.velocities(canopy[2:])[0]
    # attitude: rotation by the heading about the downward axis, then the smallest rotation from there to the axis
    tilt = Rotation.from_quat(np.append(np.cross(DOWN, axis), 1.0 + DOWN @ axis))
    side = (tilt * Rotation.from_rotvec(np.radians(p.heading_deg) * DOWN)).apply(np.array([1.0, 0.0, 0.0]))
    return np.concatenate(
        [
            canopy,
            drift + p.descent_rate_m_s * DOWN + recoil_velocity + coning_velocity,
            line,
            np.cross(line_rotation, line),
            axis,
            np.cross(axis_rotation, axis),
            side,
            [np.radians(p.spin_rate_deg_s)],
        ]
    )


def _compute_cone_direction(p: SwingParameters, modes: Modes, tilt_ratio: float) -> tuple[Vector, Vector]:
    """Compute the line's direction at the first image and its rate of change; the tilt is multiplied by a ratio.

    The line is a spherical pendulum between its largest and smallest tilt, tilt_0 and tilt_1, with the cosines z_0 and
    z_1. With the angular frequency w_0 of small swings, the angular momentum Lz about the vertical divided by the
    moment of inertia, and z = cos(tilt),

        z'^2 = 2 w_0^2 (z - z_0) (z_1 - z) (z - z_2),   z_2 = -(1 + z_0 z_1) / (z_0 + z_1),
        Lz^2 = 2 w_0^2 sin^2(tilt_0) sin^2(tilt_1) / (z_0 + z_1)

    (Landau & Lifshitz, Mechanics, 14). The phase is the parameter of the ellipse of small swings.
    """
    if p.cone_angle_deg == 0.0:
        return DOWN, np.zeros(3)
    largest, phase = np.radians(p.cone_angle_deg) / modes.lander_tilt_ratio, np.radians(p.cone_phase_deg)
    smallest = largest * p.cone_minor_fraction
    azimuth = np.radians(p.cone_direction_deg)
    major = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
    minor = np.array([np.cos(azimuth), -np.sin(azimuth), 0.0])
    offset = largest * np.cos(phase) * major + smallest * np.sin(phase) * minor
    # the tilt is never zero, because no floating-point phase has a cosine of exactly zero
    tilt = float(np.linalg.norm(offset))
    outward = offset / tilt
    tangent = np.cross(DOWN, outward)
    z0, z1, z = np.cos(largest), np.cos(smallest), np.cos(tilt)
    above_z0 = 2.0 * (np.sin(0.5 * largest) ** 2 - np.sin(0.5 * tilt) ** 2)
    below_z1 = 2.0 * (np.sin(0.5 * tilt) ** 2 - np.sin(0.5 * smallest) ** 2)
    product = (above_z0 * below_z1) * (z + (1.0 + z0 * z1) / (z0 + z1))
    tilt_rate = -np.sign(np.sin(2.0 * phase)) * modes.cone_rad_s * np.sqrt(2.0 * max(product, 0.0)) / np.sin(tilt)
    azimuthal_speed = modes.cone_rad_s * np.sqrt(2.0 / (z0 + z1)) * np.sin(largest) * np.sin(smallest) / np.sin(tilt)
    scaled_tilt = tilt_ratio * tilt
    direction = np.sin(scaled_tilt) * outward + np.cos(scaled_tilt) * DOWN
    rate = tilt_ratio * tilt_rate * (np.cos(scaled_tilt) * outward - np.sin(scaled_tilt) * DOWN)
    return direction, rate + np.sin(scaled_tilt) / np.sin(tilt) * azimuthal_speed * tangent


def _perpendicular(vector: Vector, direction: Vector) -> Vector:
    """Return the unit vector along the component of a vector perpendicular to a direction."""
    component = vector - (vector @ direction) * direction
    return np.asarray(component / np.linalg.norm(component))
