"""Chi-square test of the coarse stage's patch offsets against the covariance of the navigation state.

An image is rectified with the estimated attitude and position and the measured height. A patch at the ground point G
lies in the direction d = G - C from the camera, at the height H above it. To first order, with the errors of position
dp and velocity dv of the last image, of attitude e (rotation vector) and of height dh, true minus estimated, the patch
is found on the map at the offset

    o = dp - dv t + (e x d)_h + (d_h / H) ((e x d)_z + dh) + (d_h / H) dz + n

t is the time from the image to the last one, and the index h means the horizontal part. dz is the map's error of
elevation, n its distortion and the error of matching. The ground is level within a patch.
The position error is estimated as its conditional mean: with the covariance C of dp and o, dp = C S^-1 o, with the
covariance P - C S^-1 C'. The patches at different angles thereby determine errors of height and attitude, too.
If the stated covariances are correct, the offsets are normally distributed with zero mean and the covariance S, and
o' S^-1 o is chi-square with two degrees of freedom per patch (Bar-Shalom, Li and Kirubarajan, Estimation with
Applications to Tracking and Navigation, section 5.4). An attitude error shifts patches at large off-nadir angles more
than those at the nadir. An error above the stated one therefore increases o' S^-1 o, although the offsets have nearly
the same value.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, Int
from scipy.special import bdtrc, chdtri

from marsyard.algorithms.arrays import Flags, Points2, Points3, Vector
from marsyard.algorithms.localisation.inertial_state import ATTITUDE, MOTION, POSITION, VELOCITY
from marsyard.algorithms.localisation.matrices import cross_matrix

#: Coordinates of an offset.
_AXES = 2


@dataclass(frozen=True)
class PatchGeometry:
    """Patches of several images.

    - images: index of each patch's image; centres_m: centres on the map, horizontal; sides_m: sides of the squares
    - lines_m: from the camera to the ground at the patch's centre (east, north, up)
    - ages_s: time from the patch's image to the last image
    """

    images: Int[np.ndarray, "n"]
    centres_m: Points2
    sides_m: Vector
    lines_m: Points3
    ages_s: Vector

    def select(self, members: Flags) -> PatchGeometry:
        """Return the geometry of some of the patches."""
        return PatchGeometry(*(getattr(self, field.name)[members] for field in fields(self)))


@dataclass(frozen=True)
class OffsetErrors:
    """Standard deviations of the errors that are not in the navigation state.

    - height_m: height of each patch's camera above the ground, as measured
    - distortion_m, elevation_m: errors of the map
    - matching_m: error of matching per axis
    """

    height_m: Vector
    distortion_m: float
    elevation_m: float
    matching_m: float


def offset_covariance(
    patches: PatchGeometry, state_covariance: Float[np.ndarray, "9 9"], errors: OffsetErrors
) -> Float[np.ndarray, "m m"]:
    """Compute the covariance S of the patches' offsets, in the order (east, north) of each patch.

    - state_covariance: of the errors of position, velocity and attitude (world axes) at the last image

    The height has an error that is equal in all images (scale of the altimeter, nearest ground instead of the nadir)
    and one for each image, both with the stated standard deviation. Two patches share the map's errors by the fraction
    of their area that overlaps.
    """
    count, tangents, flat = len(patches.images), _tangents(patches), _state_jacobian(patches)
    height = (tangents * errors.height_m[:, np.newaxis]).reshape(-1)
    same_image = (patches.images[:, np.newaxis] == patches.images).astype(np.float64)
    overlap = _overlap(patches)
    elevation = errors.elevation_m * tangents.reshape(-1)

    def repeat_for_axes(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "m m"]:
        """Repeat the value of each pair of patches for all pairs of their coordinates."""
        return np.repeat(np.repeat(matrix, _AXES, axis=0), _AXES, axis=1)

    return np.asarray(
        flat @ state_covariance @ flat.T
        + np.outer(height, height) * (1.0 + repeat_for_axes(same_image))
        + np.outer(elevation, elevation) * repeat_for_axes(overlap)
        + errors.distortion_m**2 * np.kron(overlap, np.eye(_AXES))
        + errors.matching_m**2 * np.eye(_AXES * count)
    )


def estimate_position_error(
    offsets_m: Points2, patches: PatchGeometry, state_covariance: Float[np.ndarray, "9 9"], errors: OffsetErrors
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"]]:
    """Estimate the horizontal position error (true minus estimated) from the patches' offsets; return its covariance.

    The arguments are those of `offset_covariance`.
    """
    position = slice(POSITION.start, POSITION.start + _AXES)
    cross = state_covariance[position] @ _state_jacobian(patches).T
    gain = np.linalg.solve(offset_covariance(patches, state_covariance, errors), cross.T).T
    covariance = state_covariance[position, position] - gain @ cross.T
    return gain @ offsets_m.reshape(-1), 0.5 * (covariance + covariance.T)


def _tangents(patches: PatchGeometry) -> Points2:
    """Return d_h / H of each patch."""
    return np.asarray(patches.lines_m[:, :2] / -patches.lines_m[:, 2:])


def _state_jacobian(patches: PatchGeometry) -> Float[np.ndarray, "m 9"]:
    """Return the derivatives of the offsets with respect to position, velocity and attitude of the last image."""
    count, tangents = len(patches.images), _tangents(patches)
    # horizontal shift of a patch by a displacement (east, north, up) of its line of sight
    project = np.concatenate([np.tile(np.eye(2), (count, 1, 1)), tangents[:, :, np.newaxis]], axis=2)
    jacobian = np.zeros((count, _AXES, MOTION.stop))
    jacobian[:, :, POSITION] = np.eye(2, 3)
    jacobian[:, :, VELOCITY] = -patches.ages_s[:, np.newaxis, np.newaxis] * np.eye(2, 3)
    # e x d = -[d]x e
    jacobian[:, :, ATTITUDE] = project @ -cross_matrix(patches.lines_m)
    return jacobian.reshape(-1, MOTION.stop)


def _overlap(patches: PatchGeometry) -> Float[np.ndarray, "n n"]:
    """Correlation of the map's errors in two squares: their common area / geometric mean of their areas."""
    low, high = (patches.centres_m + sign * 0.5 * patches.sides_m[:, np.newaxis] for sign in (-1.0, 1.0))
    lengths = np.minimum(high[:, np.newaxis], high) - np.maximum(low[:, np.newaxis], low)
    areas = np.prod(np.maximum(lengths, 0.0), axis=2)
    return np.asarray(areas / np.outer(patches.sides_m, patches.sides_m))


@dataclass(frozen=True)
class Consistency:
    """Result of the test.

    - members: whether each patch is kept (not an outlier)
    - normalised_square, limit: o' S^-1 o of the members' offsets, and the quantile of chi-square that it must not reach
    - outlier_probability: probability that at least as many wrong patches as removed are near the others by chance
    - false_refusal: probability to refuse correct patches, of each of the two tests
    """

    members: Flags
    normalised_square: float
    limit: float
    outlier_probability: float
    false_refusal: float

    @property
    def is_consistent(self) -> bool:
        """Whether the offsets of the members fit the stated errors, and chance explains the removed patches."""
        return self.normalised_square < self.limit and self.outlier_probability >= self.false_refusal


@dataclass(frozen=True)
class OffsetTest:
    """Probabilities of the test.

    - outlier_probability: to remove a given correct patch
    - false_refusal: to refuse correct patches
    - chance_agreement: that a wrong patch is near the others by chance
    """

    outlier_probability: float
    false_refusal: float
    chance_agreement: float


def check_offsets(
    offsets_m: Points2, covariance: Float[np.ndarray, "m m"], distant: int, test: OffsetTest
) -> Consistency:
    """Test offsets against their covariance.

    1. The patch that fits the others worst is removed, while its residual from their prediction is improbable.
    2. The removed patches are wrong ones that are near the others by chance. Their number is compared with the binomial
       distribution: the removal of many patches would leave those that agree with a wrong state.
    3. The normalised square of the remaining offsets is compared with the quantile of chi-square.

    - offsets_m: offsets of the patches that agree with each other
    - distant: number of the other patches, whose offsets are wrong
    """
    members = np.ones(len(offsets_m), dtype=bool)
    while True:
        rows = np.repeat(members, _AXES)
        values = offsets_m[members].reshape(-1)
        precision = np.linalg.inv(covariance[np.ix_(rows, rows)])
        weighted = precision @ values
        count = int(np.count_nonzero(members))
        removed = len(members) - count
        # binomial probability of at least `removed` agreements by chance; 1 without a removed patch
        chance = float(bdtrc(removed - 1, removed + distant, test.chance_agreement)) if removed else 1.0
        limit = float(chdtri(len(values), test.false_refusal))
        result = Consistency(members, float(values @ weighted), limit, chance, test.false_refusal)
        if count < 2:
            return result
        # normalised square of each patch's residual from its prediction by the others (conditional Gaussian)
        blocks = precision.reshape(count, _AXES, count, _AXES)[np.arange(count), :, np.arange(count), :]
        vectors = weighted.reshape(count, _AXES)
        squares = np.einsum("ni,ni->n", vectors, np.linalg.solve(blocks, vectors[..., np.newaxis])[..., 0])
        worst = int(np.argmax(squares))
        if squares[worst] < chdtri(_AXES, test.outlier_probability):
            return result
        members = members.copy()
        members[np.flatnonzero(members)[worst]] = False
