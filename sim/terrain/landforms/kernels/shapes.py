"""Compiled shapes of craters, lava, channels and fans, added to periodic square grids in place.

The side of a grid is a power of two: ``index & (side - 1)`` is the index within the period.
"""

import math

from numba import njit

from marsyard.sim.terrain.kernels import Array, Grid

#: Relative change of the rim height of a crater per relative change of its radius.
RIM_HEIGHT_SENSITIVITY = 8.0
#: RMS of the rays relative to the mean thickness and opacity of the ejecta (assumed).
RAY_CONTRAST = 0.25
#: Mean radius of the deposit in the middle of a crater's fill, in crater radii; its change per relative displacement of
#: an outline, and towards the lee; wavelength and height of the ridges on it, metres (assumed; transverse ridges in
#: craters: Balme et al. 2008).
CORE_RADIUS, CORE_SCALLOPS, CORE_LEE, RIDGE_WAVELENGTH_M, RIDGE_HEIGHT_M = 0.7, 4.0, 0.5, 10.0, 0.3
#: Finer scallops in the fill's border of large craters: their size, and the factor of their wavenumbers (assumed).
TEETH, TEETH_STEP = 0.3, 5


@njit(cache=True, inline="always")
def _azimuth_fraction(c: float, s: float) -> float:
    """Return an angle from its cosine and sine as a fraction of a turn, uniform along the square |x| + |y| = 1."""
    quarter = s / (abs(c) + abs(s))
    if c < 0.0:
        return 0.5 - 0.25 * quarter
    return 0.25 * quarter if s >= 0.0 else 1.0 + 0.25 * quarter


@njit(cache=True, inline="always")
def _core_deposit(
    dx: float, dy: float, radius: float, scallop: float, lee_x: float, lee_y: float
) -> tuple[float, float]:
    """Return the coverage by the deposit in a crater's middle, and the height of its ridges, metres.

    The deposit's border has the relative displacement `scallop` of an outline, and is nearer to the middle in the
    direction (lee_x, lee_y), where there is more sand; the ridges run across it, and their crests wander.
    """
    along = lee_x * dx + lee_y * dy
    border = radius * CORE_RADIUS * (1.0 + CORE_SCALLOPS * scallop) - CORE_RADIUS * CORE_LEE * along
    coverage = 1.5 * (1.0 - (dx * dx + dy * dy) / max(border * border, 1e-9))
    phase = along / max(math.hypot(lee_x, lee_y), 1e-9)
    phase += 4.0 * math.sin((lee_x * dy - lee_y * dx) / RIDGE_WAVELENGTH_M)
    ridge = RIDGE_HEIGHT_M * math.sin(2.0 * math.pi / RIDGE_WAVELENGTH_M * phase)
    return min(max(coverage, 0.0), 1.0), ridge


@njit(cache=True)
def stamp_craters(height: Grid, log_albedo: Grid, spacing: float, craters: Array, outlines: Array, rays: Array) -> None:
    """Add bowls, rims and ejecta of craters to height and to the logarithm of albedo, in order.

    Each crater is a row of `craters`:

    - x, y, radius; depth below the surroundings, rim height, width of the rounded rim crest, all in metres
    - fraction of the depth that is filled; changes of the logarithm of albedo on the ejecta and on the fill; radius of
      the fill in crater radii; relative increase of its strength per radius along x and y
    - number of its outline; rotation of outline and rays, as a fraction of a turn
    - extent of the ejecta in radii; their optical depth a at the rim; width of the margin in which the fill thins out,
      in radii; coverage by a deposit with ridges in its middle. 0: none, and the scallops of the rim reach the centre

    `outlines` and `rays` have a row per outline: the relative change of the radius, and the strength of the rays, at
    positions of `_azimuth_fraction`. With the distance r from the centre in radii, the bowl rises with r**2.2. The
    ejecta blanket falls with r**-3, has rays outside the rim and ends at its extent. The rim is lower where the outline
    is displaced inwards. The ejecta change the albedo where they cover the ground: by 1 - exp(-a r**-3), and by r**2 of
    that within the rim, because debris covers them towards the middle.
    """
    mask, positions = height.shape[0] - 1, outlines.shape[1]
    for n in range(craters.shape[0]):
        x, y, radius, depth, rim, rounding, fill, ejecta_log_albedo, fill_log_albedo, fill_radius = craters[n, :10]
        lee_x, lee_y, number, rotation, max_r, opacity, margin, core = craters[n, 10:]
        outline, ray = outlines[int(number)], rays[int(number)]
        extent = max_r * radius * (1.0 + outline.max())
        # depth of the bowl before its fill
        bottom = depth / (1.0 - fill)
        blend_width = 0.25 * fill * bottom + 1e-9
        for i in range(math.ceil((y - extent) / spacing), math.floor((y + extent) / spacing) + 1):
            dy = i * spacing - y
            chord = math.sqrt(max(extent * extent - dy * dy, 0.0))
            for j in range(math.ceil((x - chord) / spacing), math.floor((x + chord) / spacing) + 1):
                dx = j * spacing - x
                d = math.sqrt(dx * dx + dy * dy)
                if d >= extent:
                    continue
                c, s = dx / max(d, 1e-9), dy / max(d, 1e-9)
                position = (_azimuth_fraction(c, s) + rotation) * positions if d > 0.0 else 0.0
                k = int(position)
                weight = position - k
                first, second = k % positions, (k + 1) % positions
                displacement = outline[first] + weight * (outline[second] - outline[first])
                if core > 0.0:
                    # scallops of the rim fade towards the middle and on the ejecta
                    square = d * d / (radius * radius)
                    displacement *= min(square, 1.0 / max(square, 1.0))
                # distance from the centre in local radii: 1 on the rim
                r = d / (radius * (1.0 + displacement))
                if r >= max_r:
                    continue
                # inside the bowl the blanket's r**-3 is limited
                outside = max(r, 0.6)
                thickness = 1.0 / (outside * outside * outside)
                fade = min((max_r - r) / (max_r - 1.0), 1.0)
                strength = 1.0
                if r > 1.0:
                    # rays begin at the rim
                    along = ray[first] + weight * (ray[second] - ray[first])
                    strength = max(1.0 + RAY_CONTRAST * along * min(2.0 * (r - 1.0), 1.0), 0.0)
                blanket = rim * max(1.0 + RIM_HEIGHT_SENSITIVITY * displacement, 0.0) * thickness * fade * strength
                change = blanket
                # the profile is the lower one of the bowl, extended outwards, and the ejecta blanket
                if r <= 1.0 or (rim + bottom) * r * r - bottom < blanket + rounding:
                    bowl = (rim + bottom) * r**2.2 - bottom
                    if fill > 0.0:
                        # smooth maximum of bowl and floor
                        blend = max(blend_width - abs(bowl + depth), 0.0)
                        bowl = max(bowl, -depth) + blend * blend / (4.0 * blend_width)
                    overlap = max(rounding - abs(bowl - blanket), 0.0)
                    change = min(bowl, blanket) - overlap * overlap / (4.0 * max(rounding, 1e-9))
                row, column = i & mask, j & mask
                height[row, column] += change
                if ejecta_log_albedo != 0.0:
                    coverage = 1.0 - math.exp(-opacity * thickness * strength)
                    log_albedo[row, column] += ejecta_log_albedo * coverage * fade * min(r * r, 1.0)
                if fill_log_albedo != 0.0 and r < fill_radius:
                    # the fill thins out at its margin, and upwind
                    edge = fill_radius - r + (TEETH * outline[(TEETH_STEP * k) % positions] if core > 0.0 else 0.0)
                    filled = min(max(edge, 0.0) / margin, 1.0) * (1.0 + lee_x * c * r + lee_y * s * r)
                    if core > 0.0:
                        middle, ridge = _core_deposit(
                            dx, dy, radius, outline[(first + positions // 2) % positions], lee_x, lee_y
                        )
                        filled *= 1.0 - core * middle
                        height[row, column] += core * middle * ridge
                    log_albedo[row, column] += fill_log_albedo * filled


@njit(cache=True)
def scale_roughness(factors: Grid, spacing: float, craters: Array, max_r: float) -> None:
    """Scale the amplitude of fine relief: lower on filled crater floors, higher on fresh ejecta.

    `factors` is the relative amplitude on a grid. `craters` has rows (x, y, radius, factor on the floor, factor on the
    ejecta). `max_r` is the maximum distance of ejecta from the centre, in radii.
    """
    mask = factors.shape[0] - 1
    for n in range(craters.shape[0]):
        x, y, radius, floor, ejecta = craters[n]
        extent = max_r * radius
        for i in range(math.ceil((y - extent) / spacing), math.floor((y + extent) / spacing) + 1):
            dy = i * spacing - y
            for j in range(math.ceil((x - extent) / spacing), math.floor((x + extent) / spacing) + 1):
                dx = j * spacing - x
                r = math.sqrt(dx * dx + dy * dy) / radius
                if r < 1.0:
                    factors[i & mask, j & mask] *= floor + (ejecta - floor) * r * r * r * r
                elif r < max_r:
                    factors[i & mask, j & mask] *= 1.0 + (ejecta - 1.0) * (max_r - r) / (max_r - 1.0)


@njit(cache=True)
def stamp_streaks(log_albedo: Grid, spacing: float, streaks: Array) -> None:
    """Add wind tails (streaks) of craters to the logarithm of albedo.

    `streaks` has rows (x, y, half width, length, cosine and sine of the downwind direction, logarithm of albedo). A
    tail begins at (x, y), widens downwind from 0.8 to 1.6 half widths, and fades towards its end and sides.
    """
    mask = log_albedo.shape[0] - 1
    for n in range(streaks.shape[0]):
        x, y, half_width, length, c, s, streak_log_albedo = streaks[n]
        max_half_width = 1.6 * half_width
        extent_x = max(c * length, 0.0) + max_half_width, max(-c * length, 0.0) + max_half_width
        extent_y = max(s * length, 0.0) + max_half_width, max(-s * length, 0.0) + max_half_width
        for i in range(math.ceil((y - extent_y[1]) / spacing), math.floor((y + extent_y[0]) / spacing) + 1):
            dy = i * spacing - y
            for j in range(math.ceil((x - extent_x[1]) / spacing), math.floor((x + extent_x[0]) / spacing) + 1):
                dx = j * spacing - x
                along = (c * dx + s * dy) / length
                if along <= 0.0 or along >= 1.0:
                    continue
                across = (c * dy - s * dx) / (half_width * (0.8 + 0.8 * along))
                if abs(across) < 1.0:
                    side = 1.0 - across * across
                    log_albedo[i & mask, j & mask] += (
                        streak_log_albedo * side * side * (1.0 - along) * min(along * length / half_width, 1.0)
                    )


@njit(cache=True)
def stamp_lobes(height: Grid, log_albedo: Grid, spacing: float, lobes: Array, warp_x: Grid, warp_y: Grid) -> None:
    """Stack lava lobes: plateaus with a steep, crenulated margin and a slightly lower middle.

    `lobes` has rows (x, y, half length, half width, thickness, cosine and sine of the direction, logarithm of albedo).
    `warp_x` and `warp_y` are displacements of the outlines in half widths; they make the outlines irregular. The albedo
    of a lobe replaces that of the lobes below.
    """
    mask = height.shape[0] - 1
    for n in range(lobes.shape[0]):
        x, y, half_length, half_width, thickness, c, s, lobe_log_albedo = lobes[n]
        extent_x = 1.3 * (half_length * abs(c) + half_width * abs(s)) + 0.5 * half_width
        extent_y = 1.3 * (half_length * abs(s) + half_width * abs(c)) + 0.5 * half_width
        for i in range(math.ceil((y - extent_y) / spacing), math.floor((y + extent_y) / spacing) + 1):
            row = i & mask
            for j in range(math.ceil((x - extent_x) / spacing), math.floor((x + extent_x) / spacing) + 1):
                column = j & mask
                dx = j * spacing - x + warp_x[row, column] * half_width
                dy = i * spacing - y + warp_y[row, column] * half_width
                p = (c * dx + s * dy) / half_length
                q = (c * dy - s * dx) / half_width
                radius2 = p * p + q * q
                if radius2 >= 1.0:
                    continue
                edge = 1.0 - (radius2 * radius2) * (radius2 * radius2)
                height[row, column] += thickness * edge * (0.65 + 0.35 * radius2)
                log_albedo[row, column] += (lobe_log_albedo - log_albedo[row, column]) * edge


@njit(cache=True)
def cut_channels(depths: Grid, spacing: float, discs: Array, sharpness: float) -> None:
    """Cut channels: discs with rows (x, y, half width w, depth) and the profile ``depth (1 - (r / w)**sharpness)``.

    `depths` is the depth below the ground, changed in place; where channels overlap it is the larger depth.
    """
    mask = depths.shape[0] - 1
    for n in range(discs.shape[0]):
        x, y, half_width, depth = discs[n]
        for i in range(math.ceil((y - half_width) / spacing), math.floor((y + half_width) / spacing) + 1):
            dy = i * spacing - y
            for j in range(math.ceil((x - half_width) / spacing), math.floor((x + half_width) / spacing) + 1):
                dx = j * spacing - x
                ratio = math.sqrt(dx * dx + dy * dy) / half_width
                if ratio < 1.0:
                    local_depth = depth * (1.0 - ratio**sharpness)
                    if local_depth > depths[i & mask, j & mask]:
                        depths[i & mask, j & mask] = local_depth


@njit(cache=True)
def raise_cones(
    height: Grid, coverage: Grid, spacing: float, apexes: Array, slope: float, concavity: float, rounding: float
) -> None:
    """Add the union of concave cones with rows (x, y, radius R) in `apexes`; `coverage` is 1 on the cones.

    The height at the distance r from the apex is ``slope R / concavity (1 - r / R)**concavity``. The apex is rounded,
    with the slope `slope` next to it.
    """
    side = height.shape[0]
    period = side * spacing
    # height from which the coverage is 1: 2 % of the first cone's slope times radius
    full_height = 0.02 * slope * apexes[0, 2]
    for i in range(side):
        for j in range(side):
            total = 0.0
            for n in range(apexes.shape[0]):
                x, y, radius = apexes[n]
                dx, dy = abs(j * spacing - x), abs(i * spacing - y)
                dx, dy = min(dx, period - dx), min(dy, period - dy)
                distance = math.sqrt(dx * dx + dy * dy + rounding * rounding) - rounding
                remaining = 1.0 - distance / radius
                if remaining > 0.0:
                    z = slope * radius / concavity * remaining**concavity
                    # smooth maximum of all cones: norm of order 8
                    total += z**8
            if total > 0.0:
                z = total**0.125
                height[i, j] += z
                coverage[i, j] = min(z / full_height, 1.0)
