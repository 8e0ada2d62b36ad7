"""Products of arrays of quaternions (x, y, z, w), faster than those of SciPy's `Rotation`."""

import numpy as np
from jaxtyping import Float64

Quaternions = Float64[np.ndarray, "n 4"]  #: In the order x, y, z, w.


def multiply_quaternions(left: Quaternions, right: Quaternions) -> Quaternions:
    """Multiply quaternions (x, y, z, w) pairwise, faster than `Rotation`; the right rotation is applied first."""
    ax, ay, az, aw = left.T
    bx, by, bz, bw = right.T
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by + ay * bw + az * bx - ax * bz
    z = aw * bz + az * bw + ax * by - ay * bx
    return np.stack([x, y, z, aw * bw - ax * bx - ay * by - az * bz], axis=1)


def accumulate_quaternions(steps: Quaternions) -> Quaternions:
    """Compute the products of the first 1, 2, ... n quaternions; each step multiplies from the right.

    Recursion: the cumulative products of pairs are every second result; the others require one more product each.
    """
    count = len(steps)
    if count == 1:
        return steps
    pair_products = accumulate_quaternions(multiply_quaternions(steps[: count - 1 : 2], steps[1::2]))
    cumulative = np.empty((count, 4))
    cumulative[0] = steps[0]
    cumulative[1::2] = pair_products
    cumulative[2::2] = multiply_quaternions(pair_products[: (count - 1) // 2], steps[2::2])
    return cumulative
