"""Conformance suite of position estimators: synthetic descents, and the rules for the answers to them.

A position estimator follows the interface `marsyard.algorithms.localisation.interface.PositionEstimator`: it receives
the measurements of a descent one by one, and answers each image, and the end of the descent, with a position.
`StreamSuite` runs the checks that all streams have in common; the `SuiteRules` of this module gives it the descents,
and the check of their answers. `position_suite(...)` creates the suite for one estimator (`marsyard conformance`).

The ground is level and textured, and its map exact: the textured plane of the conformance suites, without renderer. The
lander descends at constant velocity and turns slowly, so that its inertial increments are exact.
"""

from dataclasses import replace
from functools import cache, partial

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from marsyard.algorithms.localisation.interface import InitialState, MapProduct, PositionEstimate, PositionOutcome
from marsyard.scenarios.conformance.estimators import StreamSuite, SuiteRules, Unusual, unusual_images
from marsyard.scenarios.conformance.inputs import BLANKS, MEAN_RADIANCE, Blank, TexturedPlane, texture
from marsyard.scenarios.localisation.camera import LanderCameraParameters, true_camera
from marsyard.scenarios.localisation.measurements import LocalisationMeasurements
from marsyard.scenarios.streamed import StreamAnswers
from marsyard.sim.camera import Cahvore
from marsyard.sim.frames import rigid
from marsyard.sim.measurements import AltitudeMeasurement, DetectorCalibration, DetectorImage, ImuIncrements

#: Motion of the lander: position at time 0 and constant velocity (east, north, up), attitude at time 0 about z, y and
#: x, turn rate about the vertical; gravity of Mars.
START_M, VELOCITY_M_S = np.array([150.0, -120.0, 2400.0]), np.array([8.0, -5.0, -60.0])
_ATTITUDE_DEG, _TURN_RAD_S, _GRAVITY_M_S2 = (20.0, 3.0, -4.0), 0.02, 3.71
#: Error of the initial position (estimate minus truth), and standard deviations of the initial state per axis.
_ERROR_M = np.array([160.0, -110.0, 20.0])
_POSITION_SD_M, _VELOCITY_SD_M_S, _ATTITUDE_SD_RAD = (150.0, 150.0, 50.0), 0.5, 1e-3
#: Rates of the inertial unit and the altimeter, time of the last increment, and times of the images.
_IMU_HZ, _ALTIMETER_HZ, _END_S = 100.0, 2.0, 8.0
_IMAGE_TIMES_S = np.array([1.0, 3.0, 5.0, 7.0])
#: Spacing of the texture's samples; pixel and size of the map.
_TEXTURE_STEP_M, _MAP_PIXEL_M, _MAP_PX = 12.0, 6.0, 640
#: Counts of the 8-bit camera at the mean radiance, and without light.
_MEAN_DN, _OFFSET_DN, _FULL_SCALE_DN = 110.0, 2.0, 255
#: Jitter of the time tags: images and altitudes, s; inertial data, as a fraction of the interval.
_TAG_JITTER_S, _IMU_JITTER = 0.005, 0.4
#: Index of a boundary of the increments whose tag is equal to the next one.
_EQUAL_TAG = 50

#: Counts of the blank images of this suite; `black` is below the offset.
BLANK_COUNTS: dict[str, Blank] = {**BLANKS, "black": lambda _: 0}


def true_position(time_s: float) -> Float64[np.ndarray, "3"]:
    """Return the true position at a time."""
    return np.asarray(START_M + time_s * VELOCITY_M_S)


@cache
def ordinary_descent() -> LocalisationMeasurements:
    """Create an ordinary descent; only the initial position has an error."""
    variances = np.square([*_POSITION_SD_M, *[_VELOCITY_SD_M_S] * 3, *[_ATTITUDE_SD_RAD] * 3])
    position = true_position(0.0) + _ERROR_M
    initial = InitialState(0.0, position, VELOCITY_M_S, _attitude(0.0), np.diag(variances), _GRAVITY_M_S2)
    return LocalisationMeasurements(initial, _map(), _increments(), _altitudes(), _images())


def descent_on_shifted_map() -> LocalisationMeasurements:
    """Create the ordinary descent on another map: the positions of map and lander are shifted by a kilometre."""
    case, shift = ordinary_descent(), np.array([1000.0, -500.0, 0.0])
    initial = replace(case.initial, position_m=case.initial.position_m + shift)
    map_product = replace(case.map_product, origin_m=case.map_product.origin_m + shift[:2])
    return replace(case, initial=initial, map_product=map_product)


@cache
def descent_with_jitter() -> LocalisationMeasurements:
    """Create a descent with jitter of all time tags; the inertial increments remain in order.

    Two boundaries of increments have equal tags, and so have an image and an altitude.
    """
    rng, case = np.random.default_rng(20210218), ordinary_descent()
    increments = case.increments
    tags = increments.times_s + _IMU_JITTER / _IMU_HZ * rng.uniform(-1.0, 1.0, increments.times_s.size)
    tags[[0, -1]] = increments.times_s[[0, -1]]
    tags = np.maximum.accumulate(tags)
    tags[_EQUAL_TAG] = tags[_EQUAL_TAG + 1]
    images = [replace(image, time_s=image.time_s + rng.uniform(-1.0, 1.0) * _TAG_JITTER_S) for image in case.images]
    altitudes = [replace(item, time_s=item.time_s + rng.uniform(-1.0, 1.0) * _TAG_JITTER_S) for item in case.altitudes]
    altitudes[1] = replace(altitudes[1], time_s=images[0].time_s)
    return replace(case, increments=replace(increments, times_s=tags), altitudes=tuple(altitudes), images=tuple(images))


def descent_with_repeated_images() -> LocalisationMeasurements:
    """Create a descent in which all images show the first scene, and each is delivered twice."""
    case = ordinary_descent()
    images = [replace(image, counts=case.images[0].counts) for image in case.images for _ in range(2)]
    return replace(case, images=tuple(images))


def _attitude(time_s: float) -> Rotation:
    """Return the rotation from body axes to world axes."""
    return Rotation.from_rotvec([0.0, 0.0, _TURN_RAD_S * time_s]) * Rotation.from_euler(
        "ZYX", _ATTITUDE_DEG, degrees=True
    )


def _increments() -> ImuIncrements:
    """Create exact increments: the specific force is constant in world axes, the angular rate in body axes."""
    times = np.arange(round(_END_S * _IMU_HZ) + 1) / _IMU_HZ
    turn = _attitude(0.0).inv().apply([0.0, 0.0, _TURN_RAD_S / _IMU_HZ])
    force = [_attitude(time_s).inv().apply([0.0, 0.0, _GRAVITY_M_S2 / _IMU_HZ]) for time_s in times[:-1]]
    return ImuIncrements(times, 1.0 / _IMU_HZ, np.tile(turn, (times.size - 1, 1)), np.array(force))


def _altitudes() -> tuple[AltitudeMeasurement, ...]:
    times = np.arange(1, round(_END_S * _ALTIMETER_HZ)) / _ALTIMETER_HZ
    return tuple(AltitudeMeasurement(float(true_position(time_s)[2]), float(time_s)) for time_s in times)


def _images() -> tuple[DetectorImage, ...]:
    """Take the images of the ground at the height 0."""
    camera: Cahvore = true_camera(LanderCameraParameters(pixels=192, pixel_mrad=8.7))
    shape = camera.size[::-1]
    # uniform response, exposure of 150 us, no row transfer times (global shutter), no summed rows
    calibration = DetectorCalibration(np.ones(shape), 150e-6, 0.0, 0.0, 1, _OFFSET_DN, _FULL_SCALE_DN)
    ground = TexturedPlane(np.zeros(3), np.eye(3)[:2], _TEXTURE_STEP_M)
    images = []
    for time_s in _IMAGE_TIMES_S:
        radiance = ground.radiance(camera.transform(rigid(_attitude(time_s), true_position(time_s))))
        counts = np.clip(np.rint(_OFFSET_DN + _MEAN_DN / MEAN_RADIANCE * radiance), 0, _FULL_SCALE_DN).astype(np.uint16)
        images.append(DetectorImage(counts, float(time_s), camera, calibration))
    return tuple(images)


def _map() -> MapProduct:
    """Create the exact map, centred at the world's origin; it states standard deviations of 1 m."""
    offsets = _MAP_PIXEL_M * (np.arange(_MAP_PX) - _MAP_PX // 2)
    samples = np.stack(np.meshgrid(offsets, offsets, indexing="ij")) / _TEXTURE_STEP_M
    appearance = map_coordinates(texture(), samples, order=1, mode="grid-wrap").astype(np.float32)
    return MapProduct(appearance, np.zeros_like(appearance), np.full(2, offsets[0]), _MAP_PIXEL_M, 1.0, 1.0, 1.0)


def describe_answers(answers: StreamAnswers[PositionEstimate]) -> str:
    """Return the number of positions, and the outcome or the horizontal error at the end."""
    valid = sum(estimate.outcome is PositionOutcome.VALID for estimate in answers.after_images)
    final = answers.final
    end = final.outcome.name
    if final.position_m is not None:
        error_m = float(np.hypot(*(final.position_m - true_position(final.time_s))[:2]))
        end = f"{error_m:.1f} m error at the end"
    return f"{valid} of {len(answers.after_images)} images {PositionOutcome.VALID.name}; {end}"


#: The descents of the suite, and the rules for their answers.
POSITION = SuiteRules(
    measurements=ordinary_descent,
    check=lambda answer, measurements: measurements.check(answer),
    is_valid=lambda answers: answers.outcome is PositionOutcome.VALID,
    describe=describe_answers,
    failures=", ".join(outcome.name for outcome in PositionOutcome if outcome is not PositionOutcome.VALID),
    unusual={
        # a position is no violation here: inertial navigation gives one also with blank images
        **unusual_images(ordinary_descent, BLANK_COUNTS, ""),
        "repeated": Unusual("images that repeat the first, each delivered twice", (descent_with_repeated_images,)),
        "no-altitudes": Unusual("a descent without altitudes", (lambda: replace(ordinary_descent(), altitudes=()),)),
        "no-images": Unusual("a descent without images", (lambda: replace(ordinary_descent(), images=()),)),
        "jitter": Unusual("time tags with jitter, some of them equal", (descent_with_jitter,)),
    },
    interface="algorithms/localisation/interface.py",
    interrupted=descent_on_shifted_map,
)
position_suite = partial(StreamSuite, rules=POSITION)
