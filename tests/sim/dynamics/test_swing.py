"""Tests of the descent on a parachute, a double pendulum: conservation laws, linear theory and initial conditions.

In the slow mode the line below the canopy cones; in the fast mode the lander nods on its bridle.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp

from marsyard.sim.dynamics.kernels.swing import Chain, compute_aerodynamic_force, compute_derivatives
from marsyard.sim.dynamics.kernels.wind import WindField
from marsyard.sim.dynamics.pendulum import Modes, SwingParameters, build_chain
from marsyard.sim.dynamics.swing import SwingDescent

#: Position of the first image, m; height of the ground, m; gravity, m/s2.
START = np.array([100.0, -50.0, 2100.0])
GROUND_M = 100.0
GRAVITY = 3.72
UP = np.array([0.0, 0.0, 1.0])
#: Weights of the first derivative from five equidistant values.
FIVE_POINT_DERIVATIVE = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12.0
#: No gusts and no damping.
UNDISTURBED = {"gust_intensity_m_s": 0.0, "cone_damping_ratio": 0.0, "nod_damping_ratio": 0.0}
VERTICAL_FALL = UNDISTURBED | {"cone_angle_deg": 0.0, "nod_rate_deg_s": 0.0}
LARGE_MOTION = {
    "wind_east_m_s": 20.0,
    "wind_north_m_s": -8.0,
    "gust_intensity_m_s": 3.0,
    "cone_angle_deg": 30.0,
    "cone_minor_fraction": -0.6,
    "cone_direction_deg": 70.0,
    "cone_phase_deg": 130.0,
    "nod_rate_deg_s": 60.0,
    "nod_direction_deg": 50.0,
    "nod_phase_deg": 200.0,
    "heading_deg": 300.0,
    "spin_rate_deg_s": 5.0,
}


def _fly(seed: int = 1, start_m: np.ndarray = START, lead_s: float = 10.0, /, **parameters: Any) -> SwingDescent:
    p, rng = SwingParameters(**parameters), np.random.default_rng(seed)
    return SwingDescent.simulate(p, start_m, rng, ground_height_m=GROUND_M, gravity_m_s2=GRAVITY, lead_s=lead_s)


def _compute_off_nadir_deg(descent: SwingDescent, times_s: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(descent.motion(times_s).attitudes.as_matrix()[:, 2, 2]))


def _make_calm_wind() -> WindField:
    """Return a field without mean wind and gusts."""
    return WindField(GROUND_M, 0.0, 0.0, 500.0, 0.03, np.zeros((0, 7)))


def _list_bodies(
    y: np.ndarray, chain: Chain, parameters: SwingParameters
) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Return (mass, position, velocity) of the centres of mass of canopy, backshell and lander.

    State `y` (22 components, see `kernels.swing`): r, v of the canopy; n, dn of the line; e, de of the lander's axis.
    """
    r, v, n, dn, e, de = y[:18].reshape(6, 3)
    backshell_m = parameters.line_length_m - parameters.bridle_length_m
    return [
        (parameters.canopy_mass_kg, r, v),
        (parameters.backshell_mass_kg, r + backshell_m * n, v + backshell_m * dn),
        (
            parameters.lander_mass_kg,
            r + chain.line_m * n + parameters.mass_centre_m * e,
            v + chain.line_m * dn + parameters.mass_centre_m * de,
        ),
    ]


def _compute_energy(y: np.ndarray, chain: Chain, parameters: SwingParameters) -> float:
    """Compute kinetic plus potential energy, J. `y[21]` is the spin of the lander."""
    translational = sum(0.5 * m * v @ v + m * GRAVITY * r[2] for m, r, v in _list_bodies(y, chain, parameters))
    rotational = chain.transverse_inertia * y[15:18] @ y[15:18] + chain.axial_inertia * y[21] ** 2
    return float(translational + 0.5 * rotational)


def _compute_angular_momentum(y: np.ndarray, chain: Chain, parameters: SwingParameters) -> np.ndarray:
    """Compute the angular momentum about the world origin."""
    orbital = sum(m * np.cross(r, v) for m, r, v in _list_bodies(y, chain, parameters))
    e, de = y[12:15], y[15:18]
    return np.asarray(orbital + chain.transverse_inertia * np.cross(e, de) + chain.axial_inertia * y[21] * e)


def _draw_state(rng: np.random.Generator) -> np.ndarray:
    """Draw a state vector with random directions and rates of line and lander."""
    y = np.zeros(22)
    y[:6] = [10.0, 20.0, 1500.0, 15.0, -8.0, -70.0]
    for start, rate in ((6, 0.3), (12, 1.5)):
        direction = np.array([0.0, 0.0, -1.0]) + 0.4 * rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        y[start : start + 3] = direction
        y[start + 3 : start + 6] = rate * np.cross(direction, rng.standard_normal(3))
    side = np.cross(y[12:15], UP)
    y[18:21] = side / np.linalg.norm(side)
    y[21] = 0.5
    return y


@pytest.mark.parametrize("seed", range(5))
def test_energy_and_momentum_balance_of_drag_and_friction(seed: int) -> None:
    """The rates of energy, momentum and angular momentum equal the power, forces and torques of drag and friction."""
    parameters = SwingParameters(**(LARGE_MOTION | {"nod_damping_ratio": 0.1}))
    chain = build_chain(parameters, Modes.from_parameters(parameters, GRAVITY), GRAVITY, 2000.0)
    y, wind = _draw_state(np.random.default_rng(seed)), _make_calm_wind()
    rates, force = compute_derivatives(y, chain, wind), compute_aerodynamic_force(y, chain, wind)
    n, dn, e, de = y[6:18].reshape(4, 3)
    lander_rate = np.cross(e, de) + y[21] * e
    hinge_rate = lander_rate - (lander_rate @ n) * n - np.cross(n, dn)
    step_s = 1e-5

    def rate(function: Callable[..., Any]) -> Any:
        after, before = (function(y + step * rates, chain, parameters) for step in (step_s, -step_s))
        return (after - before) / (2.0 * step_s)

    power = rate(_compute_energy)
    # Tolerance: the energy of 1e7 J is rounded to 1e-9 J, and the difference is divided by 2e-5 s.
    assert power == pytest.approx(force @ y[3:6] - chain.hinge_damping * hinge_rate @ hinge_rate, abs=1e-3)
    gravity_torque = sum(np.cross(r, -m * GRAVITY * UP) for m, r, _ in _list_bodies(y, chain, parameters))
    np.testing.assert_allclose(rate(_compute_angular_momentum), np.cross(y[:3], force) + gravity_torque, atol=1e-2)
    momentum_rate = rate(lambda *state: sum(m * v for m, _, v in _list_bodies(*state)))
    np.testing.assert_allclose(momentum_rate, force - chain.mass_kg * GRAVITY * UP, atol=1e-4)
    # The directions n and e are unit vectors, so that n . n'' = -|n'|^2.
    assert rates[9:12] @ n == pytest.approx(-dn @ dn, abs=1e-12)
    assert rates[15:18] @ e == pytest.approx(-de @ de, abs=1e-12)


def _build_linear_chain(parameters: SwingParameters) -> tuple[Chain, Modes]:
    """Build a chain that falls at a constant rate, because the air density is constant."""
    constant_density = parameters.model_copy(update={"density_scale_height_m": 1e15})
    modes = Modes.from_parameters(constant_density, GRAVITY)
    return build_chain(constant_density, modes, GRAVITY, 2000.0), modes


def _compute_eigenvalues(parameters: SwingParameters, chain: Chain) -> np.ndarray:
    """Compute eigenvalues of the equations of motion in the east-up plane, linearised at the steady fall."""

    def rates(q: np.ndarray) -> np.ndarray:
        x, line, lander, dx, dline, dlander = q
        y = np.zeros(22)
        y[:6] = [x, 0.0, 2000.0, dx, 0.0, -parameters.descent_rate_m_s]
        for start, angle, rate in ((6, line, dline), (12, lander, dlander)):
            y[start : start + 6] = [np.sin(angle), 0, -np.cos(angle), rate * np.cos(angle), 0, rate * np.sin(angle)]
        y[18:21] = [0.0, 1.0, 0.0]
        derivatives = compute_derivatives(y, chain, _make_calm_wind())
        # n'' = (theta'' cos - theta'^2 sin, 0, theta'' sin + theta'^2 cos) for the tilt theta of an axis n.
        tilt_accelerations = [
            derivatives[start] * np.cos(angle) + derivatives[start + 2] * np.sin(angle)
            for start, angle in ((9, line), (15, lander))
        ]
        return np.array([dx, dline, dlander, derivatives[3], *tilt_accelerations])

    step = 1e-5
    columns = [(rates(step * unit) - rates(-step * unit)) / (2.0 * step) for unit in np.eye(6)]
    return np.linalg.eigvals(np.stack(columns, axis=1))


def test_mode_frequencies_and_damping_match_linear_theory() -> None:
    parameters = SwingParameters(cone_angle_deg=0.0, cone_damping_ratio=0.02, nod_damping_ratio=0.05)
    chain, modes = _build_linear_chain(parameters)
    eigenvalues = _compute_eigenvalues(parameters, chain)
    cone, nod = sorted(eigenvalues[eigenvalues.imag > 0.0], key=abs)
    # The coning formula assumes a lander fixed to the line. Canopy drag adds 0.003 to the damping ratio of nods.
    assert abs(cone) == pytest.approx(modes.cone_rad_s, rel=0.02)
    assert -cone.real / abs(cone) == pytest.approx(0.02, abs=0.003)
    assert abs(nod) == pytest.approx(modes.nod_rad_s, rel=0.01)
    assert -nod.real / abs(nod) == pytest.approx(0.05 + 0.003, abs=0.002)
    # Slow and fast mode as in the field test paper.
    assert 15.0 < 2.0 * np.pi / modes.cone_rad_s < 30.0
    assert 1.0 < 2.0 * np.pi / modes.nod_rad_s < 2.5


@pytest.mark.parametrize("changes", [{}, {"cone_minor_fraction": 0.0, "cone_phase_deg": 90.0}, {"cone_angle_deg": 0.0}])
def test_velocity_rate_and_force_match_finite_differences(changes: dict[str, float]) -> None:
    descent = _fly(**(LARGE_MOTION | changes))
    step_s, times = 1e-3, np.linspace(-9.9, descent.span_s[1] - 0.1, 400)
    stencil = [descent.motion(times + offset * step_s) for offset in range(-2, 3)]
    middle = stencil[2]
    velocity = np.tensordot(FIVE_POINT_DERIVATIVE, [motion.positions_m for motion in stencil], 1) / step_s
    acceleration = np.tensordot(FIVE_POINT_DERIVATIVE, [motion.velocities_m_s for motion in stencil], 1) / step_s
    inverse = middle.attitudes.inv()
    rotations = [(inverse * motion.attitudes).as_rotvec() for motion in stencil]
    rate = np.tensordot(FIVE_POINT_DERIVATIVE, rotations, 1) / step_s
    # The dense output satisfies the equations to about 1e-6.
    np.testing.assert_allclose(velocity, middle.velocities_m_s, atol=1e-5)
    np.testing.assert_allclose(inverse.apply(acceleration + GRAVITY * UP), middle.specific_forces_m_s2, atol=1e-5)
    np.testing.assert_allclose(rate, middle.body_rates_rad_s, atol=1e-5)


def test_motion_is_continuous_at_the_first_image() -> None:
    descent = _fly(**LARGE_MOTION)
    np.testing.assert_allclose(descent.state(0.0).position_m, START, atol=1e-9)
    motion = descent.motion(np.array([-1e-9, 0.0]))
    np.testing.assert_allclose(motion.velocities_m_s[0], motion.velocities_m_s[1], atol=1e-6)
    np.testing.assert_allclose(motion.specific_forces_m_s2[0], motion.specific_forces_m_s2[1], atol=1e-6)


def test_fall_follows_terminal_velocity() -> None:
    descent = _fly(**VERTICAL_FALL, descent_rate_m_s=75.0, density_scale_height_m=10000.0)
    # Vertical fall: z'' = rho / rho_0 (g + V^2 / (2 H)) (z' / V)^2 - g, with the speed V and the density rho_0 at the
    # start, and the scale height H of the density. The specific force at the start is g + V^2 / (2 H).
    start_force = GRAVITY + 75.0**2 / 20000.0

    def fall(_t: float, y: np.ndarray) -> list[float]:
        return [y[1], np.exp((START[2] - y[0]) / 10000.0) * start_force * (y[1] / 75.0) ** 2 - GRAVITY]

    reference = solve_ivp(fall, (0.0, 26.0), [START[2], -75.0], rtol=1e-10, atol=1e-10, dense_output=True).sol
    assert reference is not None
    times = np.linspace(0.0, 26.0, 27)
    motion = descent.motion(times)
    np.testing.assert_allclose(motion.positions_m[:, 2], reference(times)[0], atol=1e-5)
    np.testing.assert_allclose(motion.velocities_m_s[:, 2], reference(times)[1], atol=1e-5)
    # The velocity stays near the balance of weight and drag.
    balanced = 75.0 * np.exp((motion.positions_m[:, 2] - START[2]) / 20000.0)
    np.testing.assert_allclose(-motion.velocities_m_s[:, 2], balanced, rtol=5e-3)
    state = descent.state(0.0)
    np.testing.assert_allclose(state.velocity_m_s, [0.0, 0.0, -75.0], atol=1e-9)
    np.testing.assert_allclose(state.specific_force_m_s2, [0.0, 0.0, start_force], atol=1e-9)
    np.testing.assert_allclose(state.body_rate_rad_s, 0.0, atol=1e-12)


def test_descent_drifts_with_the_mean_wind() -> None:
    motion = _fly(**VERTICAL_FALL, wind_east_m_s=12.0, wind_north_m_s=-7.0).motion(np.linspace(-5.0, 15.0, 21))
    np.testing.assert_allclose(motion.velocities_m_s[:, :2], np.tile([12.0, -7.0], (21, 1)), atol=1e-6)


@pytest.mark.parametrize("angle", [5.0, 30.0])
def test_circular_cone_has_a_constant_angle(angle: float) -> None:
    descent = _fly(**(UNDISTURBED | {"cone_angle_deg": angle, "cone_minor_fraction": 1.0, "nod_rate_deg_s": 0.0}))
    assert _compute_off_nadir_deg(descent, np.zeros(1))[0] == pytest.approx(angle, abs=1e-6)
    # For wide cones the lander tilt of linear theory is inaccurate. This causes nods of one degree.
    np.testing.assert_allclose(_compute_off_nadir_deg(descent, np.linspace(-5.0, 7.5, 200)), angle, atol=0.04 * angle)
    rates = descent.motion(np.zeros(1)).body_rates_rad_s[0]
    modes = Modes.from_parameters(descent.parameters, GRAVITY)
    line_tilt = np.radians(angle) / modes.lander_tilt_ratio
    # A conical pendulum rotates at omega / sqrt(cos); the lander rotates with its axis.
    expected = modes.cone_rad_s / np.sqrt(np.cos(line_tilt)) * np.sin(np.radians(angle))
    assert np.linalg.norm(rates) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("phase", [0.0, 60.0, 90.0, 200.0])
def test_plane_swing_reaches_the_specified_angle(phase: float) -> None:
    swing = {"cone_angle_deg": 30.0, "cone_minor_fraction": 0.0, "cone_phase_deg": phase, "nod_rate_deg_s": 0.0}
    descent = _fly(**(UNDISTURBED | swing))
    angles = _compute_off_nadir_deg(descent, np.linspace(-6.0, 16.0, 2000))
    assert angles.max() == pytest.approx(30.0, rel=0.03)
    assert angles.min() < 0.5


@pytest.mark.parametrize("fraction", [0.5, -0.5])
def test_cone_starts_at_its_azimuth_with_its_sense_of_rotation(fraction: float) -> None:
    cone = {"cone_angle_deg": 20.0, "cone_minor_fraction": fraction, "cone_direction_deg": 90.0, "nod_rate_deg_s": 0.0}
    descent = _fly(**(UNDISTURBED | cone))
    camera_axes = -descent.motion(np.array([0.0, 1.0])).attitudes.as_matrix()[:, :, 2]
    # The camera points east of nadir; with a positive fraction it rotates clockwise seen from above, to the south.
    np.testing.assert_allclose(camera_axes[0], [np.sin(np.radians(20.0)), 0.0, -np.cos(np.radians(20.0))], atol=1e-9)
    assert np.sign(camera_axes[1, 1]) == -np.sign(fraction)
    # A quarter of a period later it is at the smaller semi-axis.
    quarter_period_s = 0.5 * np.pi / Modes.from_parameters(descent.parameters, GRAVITY).cone_rad_s
    min_angle = _compute_off_nadir_deg(descent, np.linspace(quarter_period_s - 1.0, quarter_period_s + 1.0, 200)).min()
    assert min_angle == pytest.approx(10.0, abs=0.4)


@pytest.mark.parametrize("phase", [0.0, 45.0, 250.0])
def test_max_rate_equals_the_specified_rate(phase: float) -> None:
    parameters = VERTICAL_FALL | {"nod_rate_deg_s": 60.0, "nod_phase_deg": phase}
    descent = _fly(**parameters)
    period = 2.0 * np.pi / Modes.from_parameters(descent.parameters, GRAVITY).nod_rad_s
    motion = descent.motion(np.linspace(-0.5, 0.5, 400) * period)
    # Canopy drag reduces the rate by 2 % within a period.
    max_rate = np.degrees(np.linalg.norm(motion.body_rates_rad_s, axis=1)).max()
    assert max_rate == pytest.approx(60.0, rel=0.02)
    assert np.ptp(np.degrees(motion.body_rates_rad_s[:, 0])) == pytest.approx(120.0, rel=0.03)


def test_heading_and_spin_are_clockwise() -> None:
    descent = _fly(**VERTICAL_FALL, heading_deg=90.0, spin_rate_deg_s=5.0)
    matrices = descent.motion(np.array([0.0, 3.0])).attitudes.as_matrix()
    np.testing.assert_allclose(matrices[0, :, 1], [1.0, 0.0, 0.0], atol=1e-12)
    azimuth = np.degrees(np.arctan2(matrices[1, 0, 1], matrices[1, 1, 1]))
    assert azimuth == pytest.approx(105.0, abs=1e-6)


def test_gusts_depend_on_generator_and_swing_the_line() -> None:
    gusty = VERTICAL_FALL | {"gust_intensity_m_s": 3.0}
    first, repeated, other_seed = _fly(4, **gusty), _fly(4, **gusty), _fly(5, **gusty)
    times = np.linspace(-5.0, 20.0, 50)
    np.testing.assert_array_equal(first.motion(times).positions_m, repeated.motion(times).positions_m)
    assert np.abs(first.motion(times).positions_m - other_seed.motion(times).positions_m).max() > 1.0
    assert 0.1 < _compute_off_nadir_deg(first, times).max() < 15.0


def test_thrusters_fire_at_their_height_before_the_end() -> None:
    descent = _fly(**LARGE_MOTION)
    assert descent.state(descent.thruster_firing_s).position_m[2] == pytest.approx(GROUND_M + 100.0, abs=1e-6)
    assert descent.span_s[1] > descent.thruster_firing_s + 1.0
    assert descent.state(descent.time_of_altitude(1400.0)).position_m[2] == pytest.approx(1500.0, abs=1e-6)


@pytest.mark.slow
def test_horizontal_velocities_match_the_paper() -> None:
    """Velocities including the swing are up to 30 m/s at the images (field test paper, III.C)."""
    speeds = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        wind, azimuth = rng.uniform(0.0, 22.0), rng.uniform(0.0, 2.0 * np.pi)
        samples = {
            "wind_east_m_s": wind * np.sin(azimuth),
            "wind_north_m_s": wind * np.cos(azimuth),
            "cone_angle_deg": rng.uniform(0.0, 30.0),
            "cone_phase_deg": rng.uniform(0.0, 360.0),
        }
        motion = _fly(seed, **samples).motion(np.array([0.0, 3.75, 7.5]))
        speeds.append(np.linalg.norm(motion.velocities_m_s[:, :2], axis=1).max())
    assert 20.0 < max(speeds) < 32.0


def test_error_messages_contain_the_allowed_values() -> None:
    descent = _fly(**VERTICAL_FALL)
    with pytest.raises(ValueError, match=r"time -11 s is outside of the motion; allowed: -10 to 27\.\d+ s"):
        descent.state(-11.0)
    with pytest.raises(ValueError, match=r"altitude 5000 m is not passed; allowed: .* to 27\d\d"):
        descent.time_of_altitude(5000.0)
    with pytest.raises(ValueError, match=r"nod_rate_deg_s is 110; allowed: below \d+"):
        _fly(nod_rate_deg_s=110.0, mass_centre_m=0.2, gyration_transverse_m=1.0)
    with pytest.raises(ValueError, match=r"start_m is at z = 150\.0 m; allowed: above the thrusters' firing, 200\.0 m"):
        _fly(1, np.array([0.0, 0.0, 150.0]))
    with pytest.raises(ValueError, match=r"gyration_transverse_m of 5 with mass_centre_m of 0\.1.*; allowed: nodding"):
        _fly(mass_centre_m=0.1, gyration_transverse_m=5.0, nod_rate_deg_s=0.0)
    with pytest.raises(ValueError, match="lead_s is 60; allowed: above 0, up to 30 s"):
        _fly(1, START, 60.0)
    with pytest.raises(ValidationError, match="bridle_length_m is 60; allowed: up to line_length_m, 47"):
        SwingParameters(bridle_length_m=60.0)


def _compute_eigenvalues_by_differences(parameters: SwingParameters, chain: Chain) -> np.ndarray:
    """Compute eigenvalues of the equations of motion in the east-up plane, linearised at the steady fall."""

    def rates(q: np.ndarray) -> np.ndarray:
        x, line, lander, dx, dline, dlander = q
        y = np.zeros(22)
        y[:6] = [x, 0.0, 2000.0, dx, 0.0, -parameters.descent_rate_m_s]
        for start, angle, rate in ((6, line, dline), (12, lander, dlander)):
            y[start : start + 6] = [np.sin(angle), 0, -np.cos(angle), rate * np.cos(angle), 0, rate * np.sin(angle)]
        y[18:21] = [0.0, 1.0, 0.0]
        derivatives = compute_derivatives(y, chain, _make_calm_wind())
        # n'' = (theta'' cos - theta'^2 sin, 0, theta'' sin + theta'^2 cos) for the tilt theta of an axis n.
        tilt_accelerations = [
            derivatives[start] * np.cos(angle) + derivatives[start + 2] * np.sin(angle)
            for start, angle in ((9, line), (15, lander))
        ]
        return np.array([dx, dline, dlander, derivatives[3], *tilt_accelerations])

    step = 1e-5
    columns = [(rates(step * unit) - rates(-step * unit)) / (2.0 * step) for unit in np.eye(6)]
    return np.linalg.eigvals(np.stack(columns, axis=1))


def _compute_eigenvalues_by_matrices(parameters: SwingParameters, chain: Chain, modes: Modes) -> np.ndarray:
    """Compute eigenvalues of the planar double pendulum: canopy position x, tilts of line and lander; their rates."""
    # First and second moment S and J of the masses on the line, first moment of the lander, normal force k per radian,
    # damping c of the hinge.
    s, j, length = chain.first_moment, chain.second_moment, chain.line_m
    lander, k, speed, c = (
        parameters.lander_mass_kg * parameters.mass_centre_m,
        modes.normal_force_n,
        parameters.descent_rate_m_s,
        chain.hinge_damping,
    )
    mass = np.array(
        [
            [chain.mass_kg, s, lander],
            [s, j, lander * length],
            [lander, lander * length, chain.transverse_inertia + lander * parameters.mass_centre_m],
        ]
    )
    damping = np.array([[k / speed, 0.0, 0.0], [0.0, c, -c], [0.0, -c, c]])
    stiffness = np.diag([0.0, s * GRAVITY, lander * GRAVITY])
    stiffness[0, 1] = chain.mass_kg * GRAVITY - k
    inverse = np.linalg.inv(mass)
    upper = np.hstack([np.zeros((3, 3)), np.eye(3)])
    return np.linalg.eigvals(np.vstack([upper, np.hstack([-inverse @ stiffness, -inverse @ damping])]))


@pytest.mark.parametrize("ratio", [0.0, 0.03])
def test_small_swings_match_the_double_pendulum(ratio: float) -> None:
    parameters = SwingParameters(cone_angle_deg=0.0, cone_damping_ratio=ratio, nod_damping_ratio=ratio)
    chain, modes = _build_linear_chain(parameters)
    theory = _compute_eigenvalues_by_matrices(parameters, chain, modes)
    result = _compute_eigenvalues_by_differences(parameters, chain)
    np.testing.assert_allclose(np.sort_complex(result), np.sort_complex(theory), atol=1e-6)
