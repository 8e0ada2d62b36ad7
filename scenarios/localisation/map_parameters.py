"""Parameters of the map product and their sources of error."""

from typing import Annotated

from pydantic import Field

from marsyard.sim.error_sources import ErrorSource
from marsyard.sim.parameters import NonNegative, Parameters, Positive, bounded_field

REGISTRATION = ErrorSource("map-registration", "map: position as a whole")
DISTORTION = ErrorSource("map-distortion", "map: distortion")
ELEVATION = ErrorSource("map-elevation", "map: elevation")


class MapParameters(Parameters):
    """A map from images of the Context Camera (CTX) on an orbiter; the defaults follow the map of Mars 2020.

    The Lander Vision System used orthorectified CTX images of 6 m a pixel and elevations from CTX stereo images
    (Fergason et al. 2020, doi:10.5066/P906QQT8). CTX: 20 microradians a pixel, 6 m from 300 km (Malin et al. 2007).
    """

    pixel_m: Annotated[Positive, Field(description="size of a map pixel, m")] = 6.0
    side_px: Annotated[int, Field(ge=16, le=4096, description="rows, and columns, of the map")] = 2048
    sun_azimuth_deg: Annotated[
        float, bounded_field(0.0, 360.0, "azimuth of the sun in the orbital images, clockwise from north (15 h)")
    ] = 275.0
    sun_elevation_deg: Annotated[
        float, bounded_field(5.0, 90.0, "elevation of the sun in the orbital images (15 h local time)")
    ] = 40.0
    optical_depth: Annotated[
        float | None, Field(ge=0.0, le=10.0, description="optical depth in the orbital images; None: as at the landing")
    ] = None
    orbit_height_m: Annotated[
        float, bounded_field(1e5, 1e6, "height of the orbiter above the ground, above the map's centre, m")
    ] = 3.0e5
    signal_to_noise: Annotated[
        Positive, Field(description="mean signal divided by the SD of noise per map pixel; assumed")
    ] = 100.0
    aperture_px: Annotated[
        float, bounded_field(0.1, 1.0, "width of the ground that a detector element averages, map pixels; assumed")
    ] = 0.8
    nyquist_mtf: Annotated[
        float,
        bounded_field(
            0.01, 1.0, "MTF of optics, motion and processing, without aperture, at one cycle per two pixels; assumed"
        ),
    ] = 0.33
    bits: Annotated[int | None, Field(ge=6, le=16, description="bits of a pixel; None: not quantised")] = 8
    registration_sd_m: Annotated[
        NonNegative,
        REGISTRATION,
        Field(description="SD of the shift of the whole map, per axis, m; assumed: up to 150 m is 3 SD"),
    ] = 50.0
    distortion_sd_m: Annotated[
        NonNegative, DISTORTION, Field(description="SD of the distortion, per axis, m; assumed: one pixel")
    ] = 6.0
    distortion_length_m: Annotated[Positive, Field(description="correlation length of the distortion, m; assumed")] = (
        1500.0
    )
    elevation_sd_m: Annotated[NonNegative, ELEVATION, Field(description="SD of the elevation error, m; assumed")] = 5.0
    elevation_length_m: Annotated[
        Positive, Field(description="correlation length of the elevation error, m; assumed")
    ] = 300.0
    elevation_post_m: Annotated[
        NonNegative, Field(description="distance of the elevation model's posts, m; assumed; 0: exact in each pixel")
    ] = 20.0
