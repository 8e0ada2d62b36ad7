"""Compiled kernels for the exposure of a moving scene: motion blur, and smear during the charge transfer.

The scene is the radiance at mid exposure, extended by `pad` rows and columns beyond each border. The image velocity
(rows and columns per second) is defined on a coarse grid. A point that is at pixel x at time t after mid exposure was
at x - velocity * t at mid exposure. The velocity is constant within tiles of `TILE` x `TILE` pixels. A packet is the
charge of one pixel, which is shifted through all rows above it during the transfer.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

#: Side length of the tiles with constant image velocity, pixels.
TILE = 32
#: Integration steps per pixel of image motion.
STEPS_PER_PX = 8
#: Kernel weights below this value are skipped.
MIN_TAP = 1e-6


class Transfer(NamedTuple):
    """A moving scene during the charge transfer.

    - padded, pad: scene with border of equal width on all sides, and width of the border in pixels; without the
      additional columns of `blur`
    - response: relative response of each pixel
    - edges: first row of each block of rows, and the number of rows, shape (blocks + 1,)
    - velocity, spacing_px: image velocity, and spacing of its grid, as in `blur`
    - start_s, row_s: start time of the transfer relative to mid exposure, and time per row
    """

    padded: Array32
    pad: int
    response: Array32
    edges: NDArray[np.int64]
    velocity: Array
    spacing_px: float
    start_s: float
    row_s: float


@njit(cache=True)
def interpolate_velocity(velocity: Array, spacing_px: float, row: float, column: float) -> tuple[float, float]:
    """Interpolate the velocity bilinearly at a pixel, rows and columns per second; constant beyond the grid."""
    y = min(max(row / spacing_px, 0.0), velocity.shape[0] - 1.0)
    x = min(max(column / spacing_px, 0.0), velocity.shape[1] - 1.0)
    i, j = min(int(y), velocity.shape[0] - 2), min(int(x), velocity.shape[1] - 2)
    fy, fx = y - i, x - j
    a, b, c, d = (1.0 - fy) * (1.0 - fx), (1.0 - fy) * fx, fy * (1.0 - fx), fy * fx
    return (
        a * velocity[i, j, 0] + b * velocity[i, j + 1, 0] + c * velocity[i + 1, j, 0] + d * velocity[i + 1, j + 1, 0],
        a * velocity[i, j, 1] + b * velocity[i, j + 1, 1] + c * velocity[i + 1, j, 1] + d * velocity[i + 1, j + 1, 1],
    )


@njit(cache=True)
def _write_cubic_weights(f: float, weights: Array) -> None:
    """Write the weights of samples -1, 0, 1, 2 for 0 <= f < 1: cubic convolution (Keys 1981, a = -1/2)."""
    weights[0] = ((-0.5 * f + 1.0) * f - 0.5) * f
    weights[1] = (1.5 * f - 2.5) * f * f + 1.0
    weights[2] = ((-1.5 * f + 2.0) * f + 0.5) * f
    weights[3] = (0.5 * f - 0.5) * f * f


@njit(cache=True)
def write_path_kernel(row_path: float, column_path: float, half_size: int, kernel: Array) -> None:
    """Write the convolution kernel that averages over a straight path centred on the pixel.

    - row_path, column_path: length of the path in rows and columns
    - half_size: half size of the kernel
    - kernel: output, shape (2 half_size + 1, at least 2 half_size + 1); its sum is 1
    """
    kernel[:] = 0.0
    count = max(1, math.ceil(STEPS_PER_PX * math.sqrt(row_path * row_path + column_path * column_path)))
    row_weights, column_weights = np.empty(4), np.empty(4)
    for n in range(count):
        fraction = (n + 0.5) / count - 0.5
        y, x = fraction * row_path, fraction * column_path
        i, j = math.floor(y), math.floor(x)
        _write_cubic_weights(y - i, row_weights)
        _write_cubic_weights(x - j, column_weights)
        for p in range(4):
            for q in range(4):
                kernel[half_size + i + p - 1, half_size + j + q - 1] += row_weights[p] * column_weights[q] / count


@njit(cache=True)
def _find_tap_groups(kernel: Array, groups: NDArray[np.int64]) -> int:
    """Write row and first column of each group of four neighbouring kernel taps; return the number of groups."""
    count = 0
    for p in range(kernel.shape[0]):
        q = 0
        while q < kernel.shape[1] - 3:
            if abs(kernel[p, q]) > MIN_TAP:
                groups[count, 0], groups[count, 1] = p, q
                count += 1
                q += 4
            else:
                q += 1
    return count


@njit(cache=True)
def blur(padded: Array32, pad: int, velocity: Array, spacing_px: float, exposure_s: float, out: Array32) -> None:
    """Average the moving scene over the exposure.

    - padded, pad: scene at mid exposure with border, and width of the border; three more columns on the right, because
      four taps of the kernel are read at a time
    - velocity, spacing_px: image velocity at grid nodes (rows and columns per second), and the grid spacing in pixels
    - out: output, shape of the scene without its border
    """
    rows, columns = out.shape
    # three additional zero columns, because four taps are added at a time
    kernel = np.zeros((2 * pad + 1, 2 * pad + 4))
    line = np.empty(TILE, dtype=np.float32)
    groups = np.empty(((2 * pad + 1) * (2 * pad + 4), 2), dtype=np.int64)
    for top in range(0, rows, TILE):
        bottom = min(top + TILE, rows)
        for left in range(0, columns, TILE):
            width = min(TILE, columns - left)
            v_row, v_column = interpolate_velocity(
                velocity, spacing_px, 0.5 * (top + bottom - 1), left + 0.5 * (width - 1)
            )
            write_path_kernel(v_row * exposure_s, v_column * exposure_s, pad, kernel)
            count = _find_tap_groups(kernel, groups)
            for r in range(top, bottom):
                line[:] = 0.0
                for n in range(count):
                    p, q = groups[n]
                    a, b = np.float32(kernel[p, q]), np.float32(kernel[p, q + 1])
                    c, d = np.float32(kernel[p, q + 2]), np.float32(kernel[p, q + 3])
                    source = padded[r + p, left + q : left + q + width + 3]
                    for k in range(width):
                        line[k] += a * source[k] + b * source[k + 1] + c * source[k + 2] + d * source[k + 3]
                for k in range(width):
                    out[r, left + k] = line[k]


@njit(cache=True)
def _split_position(position: float, size: int) -> tuple[int, np.float32]:
    """Return the integer and fractional part of a position, clipped so that the next sample exists."""
    i = math.floor(position)
    if i < 0:
        return 0, np.float32(0.0)
    return (size - 2, np.float32(1.0)) if i > size - 2 else (i, np.float32(position - i))


@njit(cache=True)
def _add_shifted(
    source: Array32, shape: tuple[int, int], y: float, x: float, factor: np.float32, line: Array32, width: int
) -> None:
    """Add factor times an image at row y and columns x, x + 1, ... to a line, with bilinear interpolation.

    The image is a flat array with its shape as argument, because slicing rows is slower than adding them.
    """
    i, fy = _split_position(y, shape[0])
    j, fx = _split_position(x, shape[1] - width)
    one, shift = np.float32(1.0), np.uint64(1)
    a, b = factor * (one - fy) * (one - fx), factor * (one - fy) * fx
    c, d = factor * fy * (one - fx), factor * fy * fx
    upper = np.uint64(i * shape[1] + j)
    lower = np.uint64((i + 1) * shape[1] + j)
    for n in range(width):
        k = np.uint64(n)
        above, below = a * source[upper + k] + b * source[upper + k + shift], c * source[lower + k]
        line[n] += above + below + d * source[lower + k + shift]


@njit(cache=True)
def cumulative_row_sums(scene: Array32) -> Array32:
    """Compute sums over all rows above each row, shape (rows + 1, columns)."""
    rows, columns = scene.shape
    sums = np.empty((rows + 1, columns), dtype=np.float32)
    sums[0] = 0.0
    for r in range(rows):
        for c in range(columns):
            sums[r + 1, c] = sums[r, c] + scene[r, c]
    return sums


@njit(cache=True)
def average_blocks(image: Array32, edges: NDArray[np.int64]) -> Array32:
    """Compute means over blocks of rows, shape (blocks, columns)."""
    means = np.zeros((len(edges) - 1, image.shape[1]), dtype=np.float32)
    for block in range(len(edges) - 1):
        weight = np.float32(1.0 / (edges[block + 1] - edges[block]))
        for r in range(edges[block], edges[block + 1]):
            for c in range(image.shape[1]):
                means[block, c] += weight * image[r, c]
    return means


@njit(cache=True)
def gather_blocks(transfer: Transfer, prefix: Array32, response: Array32) -> Array32:
    """Compute the charge of packets that start at the edges of blocks and pass all rows above, radiance x rows.

    A packet that starts at the upper edge of block R passes the centre of block K < R after the transfer time of
    (R - K - 1/2) blocks. Each block of the scene is sampled at that time.

    - prefix: sums over all rows of the padded scene above each row, shape (padded rows + 1, padded columns)
    - response: mean response of each block, shape (blocks, columns)

    Returns the sum at each edge, shape (blocks + 1, columns).
    """
    pad, edges, velocity, spacing_px = transfer.pad, transfer.edges, transfer.velocity, transfer.spacing_px
    blocks, columns = response.shape
    line = np.empty(TILE, dtype=np.float32)
    sums = prefix.reshape(-1)
    out = np.zeros((blocks + 1, columns), dtype=np.float32)
    for start in range(1, blocks + 1):
        for block in range(start):
            centre = 0.5 * (edges[block] + edges[block + 1])
            time = transfer.start_s + (edges[start] - centre) * transfer.row_s
            for left in range(0, columns, TILE):
                width = min(TILE, columns - left)
                v_row, v_column = interpolate_velocity(velocity, spacing_px, centre - 0.5, left + 0.5 * (width - 1))
                y, x = pad - v_row * time, pad + left - v_column * time
                line[:] = 0.0
                _add_shifted(sums, prefix.shape, edges[block + 1] + y, x, np.float32(1.0), line, width)
                _add_shifted(sums, prefix.shape, edges[block] + y, x, np.float32(-1.0), line, width)
                for c in range(width):
                    out[start, left + c] += response[block, left + c] * line[c]
    return out


@njit(cache=True)
def add_smear(transfer: Transfer, edge_sums: Array32, charge: Array32) -> None:
    """Add the charge that each packet collects during the transfer to `charge` (radiance x seconds, in place).

    The charge from previous blocks (`gather_blocks`) is interpolated linearly between the edges of a block. The rows of
    the same block are added one by one; they are sampled when half of the block has been transferred.
    """
    padded, pad, response, edges = transfer.padded, transfer.pad, transfer.response, transfer.edges
    columns = response.shape[1]
    seconds = np.float32(transfer.row_s)
    scene, weights, total = padded.reshape(-1), response.reshape(-1), charge.reshape(-1)
    shifted = np.empty((np.max(np.diff(edges)), TILE), dtype=np.float32)
    in_block, edge_charge = np.empty(TILE, dtype=np.float32), np.empty(TILE, dtype=np.float32)
    change = np.empty(TILE, dtype=np.float32)
    for block in range(len(edges) - 1):
        first, last = edges[block], edges[block + 1]
        time = transfer.start_s + 0.5 * (last - first) * transfer.row_s
        for left in range(0, columns, TILE):
            width = min(TILE, columns - left)
            centre = 0.5 * (first + last - 1)
            v_row, v_column = interpolate_velocity(
                transfer.velocity, transfer.spacing_px, centre, left + 0.5 * (width - 1)
            )
            y, x = pad - v_row * time, pad + left - v_column * time
            shifted[:], in_block[:] = 0.0, 0.0
            for k in range(width):
                edge_charge[k] = edge_sums[block, left + k]
                change[k] = edge_sums[block + 1, left + k] - edge_charge[k]
            for r in range(first, last):
                line = shifted[r - first]
                _add_shifted(scene, padded.shape, r + y, x, np.float32(1.0), line, width)
                start = np.uint64(r * columns + left)
                for k in range(width):
                    line[k] *= weights[start + np.uint64(k)]
                    # the charge at the lower edge includes that of the block's own rows, which are added one by one
                    change[k] -= line[k]
            for r in range(first, last):
                fraction = np.float32((r - first) / (last - first))
                line = shifted[r - first]
                start = np.uint64(r * columns + left)
                for k in range(width):
                    total[start + np.uint64(k)] += seconds * (edge_charge[k] + fraction * change[k] + in_block[k])
                    in_block[k] += line[k]
