"""Relief on the horizon: layers of hills and swells in front of the sky, at an infinite distance.

Each layer has an elevation for every azimuth, and hides the sky and the farther layers below it. Its surface reflects
light as the ground does; the air in front of it has the colour of the sky behind it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import numpy as np
from jaxtyping import Float32
from jaxtyping import Float64 as FloatArray

from marsyard.sim.render.arrays import Values, clip, larger, to_device
from marsyard.sim.render.device import Array3f, Float, Float64, UInt32
from marsyard.sim.render.noise import noise_in_plane
from marsyard.sim.render.photometry import Angles, Law

#: Spurs and gullies on the faces: width, radians (three times the height, because faces are seen at a low angle), and
#: slope across them divided by that of the face (assumed).
_SPUR_RAD, _SPUR_SLOPE = 0.01, 0.5


class Relief(NamedTuple):
    """Layers of relief around a site, farthest first.

    - elevations: tangent of the elevation of the upper edge, by azimuth clockwise from north in equal steps
    - transmissions: of the air in front of each layer
    - steepness: slope of the face towards the site divided by the elevation, of each layer
    - albedo: of all layers
    """

    elevations: Float32[np.ndarray, "layers azimuths"]
    transmissions: FloatArray[np.ndarray, "layers"]
    steepness: FloatArray[np.ndarray, "layers"]
    albedo: float


@dataclass(frozen=True, eq=False)
class Skyline:
    """Relief on the device."""

    elevations: Values
    transmissions: Values
    steepness: Values
    albedo: Values
    layers: Values
    azimuths: Values

    @classmethod
    def of(cls, relief: Relief) -> Skyline:
        """Copy relief to the device."""
        layers, azimuths = relief.elevations.shape
        return cls(
            elevations=to_device(Float, relief.elevations),
            transmissions=to_device(Float, relief.transmissions),
            steepness=to_device(Float, relief.steepness),
            albedo=Float(relief.albedo),
            layers=UInt32(layers),
            azimuths=UInt32(azimuths),
        )

    def cover(self, sky: Values, direction: Values, law: Law, sun: Values, pixel_rad: Values) -> Values:
        """Return the radiance factor in directions, from that of the sky; upper edges are blurred over a pixel."""
        x, y, z = Array3f(direction)
        horizontal = larger(dr.sqrt(x * x + y * y), 1e-6)
        elevation, step = z / horizontal, 2.0 * math.pi / Float(self.azimuths)
        # `dr.atan2` aborts the process with LLVM 15, as `dr.maximum` does
        cosine = direction.y / dr.sqrt(direction.x * direction.x + direction.y * direction.y + 1e-30)
        angle = dr.acos(clip(cosine, -1.0, 1.0))
        angle = dr.select(x < 0.0, 2.0 * math.pi - angle, angle)
        position = Float(angle) / step
        column = UInt32(dr.floor(position))
        fraction, columns = position - Float(column), [(column + offset) % self.azimuths for offset in (0, 1)]
        _, spur, _ = noise_in_plane([angle, 3.0 * Float64(elevation)], Float64(_SPUR_RAD), UInt32(1))

        def add_layer(layer: Values, radiance: Values) -> tuple[Values, Values]:
            left, right = (dr.gather(Float, self.elevations, layer * self.azimuths + j) for j in columns)
            top = dr.lerp(left, right, fraction)
            # slopes of the face along the line of sight, and towards larger azimuths, where spurs end at the foot
            along = larger(top, 0.0) * dr.gather(Float, self.steepness, layer)
            relative = clip(elevation / larger(top, 1e-4), 0.0, 1.0)
            across = (right - left) / step * relative * relative + _SPUR_SLOPE * along * spur
            normal_x, normal_y = (-along * x - across * y) / horizontal, (-along * y + across * x) / horizontal
            normal = dr.normalize(Array3f(normal_x, normal_y, 1.0))
            face = self.albedo * law.radiance(Angles.of(normal, direction, sun), normal, Float(1.0), Array3f(0.0))
            hazy = dr.lerp(sky, face, dr.gather(Float, self.transmissions, layer))
            covered = clip((top - elevation) / Float(pixel_rad) + 0.5, 0.0, 1.0)
            return layer + 1, dr.lerp(radiance, hazy, covered)

        return dr.while_loop((UInt32(0), Float(sky)), lambda layer, radiance: layer < self.layers, add_layer)[1]
