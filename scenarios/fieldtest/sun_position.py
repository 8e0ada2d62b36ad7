"""Direction to the sun on Earth, by the method of low accuracy in Meeus, "Astronomical Algorithms" (1998), chapter 25.

The error is 0.01 deg in this century. Refraction (0.02 deg at 45 deg of elevation) and parallax (0.002 deg) are
neglected.
"""

from datetime import UTC, datetime

import numpy as np
from jaxtyping import Float64

from marsyard.sim.frames import direction

#: Noon of 1 January 2000, and terrestrial time minus universal time in 2002, s.
_J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)
_TT_MINUS_UT_S = 64.3
_DAY_S, _CENTURY_DAYS = 86400.0, 36525.0


def sun_direction(time: datetime, latitude_deg: float, longitude_deg: float) -> Float64[np.ndarray, "3"]:
    """Compute the unit vector to the sun's centre in the local level frame (east, north, up).

    Latitude is geodetic, longitude positive to the east. Raises ValueError for a time without a time zone.
    """
    if time.tzinfo is None:
        raise ValueError(f"the time {time} has no time zone; it needs one, as in 2002-10-15T12:00-07:00")
    days = (time - _J2000).total_seconds() / _DAY_S
    t = (days + _TT_MINUS_UT_S / _DAY_S) / _CENTURY_DAYS  # Julian centuries since J2000
    # Meeus 25.2 to 25.8: mean longitude and anomaly, equation of centre, apparent longitude (nutation, aberration)
    mean_longitude = 280.46646 + 36000.76983 * t + 0.0003032 * t**2
    anomaly = np.radians(357.52911 + 35999.05029 * t - 0.0001537 * t**2)
    equation_of_centre = (
        (1.914602 - 0.004817 * t) * np.sin(anomaly)
        + (0.019993 - 0.000101 * t) * np.sin(2.0 * anomaly)
        + 0.000289 * np.sin(3.0 * anomaly)
    )
    node = np.radians(125.04 - 1934.136 * t)
    longitude = np.radians(mean_longitude + equation_of_centre - 0.00569 - 0.00478 * np.sin(node))
    obliquity = np.radians(23.4392911 - 0.0130042 * t + 0.00256 * np.cos(node))
    right_ascension = np.arctan2(np.cos(obliquity) * np.sin(longitude), np.cos(longitude))
    declination = np.arcsin(np.sin(obliquity) * np.sin(longitude))
    # mean sidereal time at Greenwich (Meeus 12.4); nutation, at most 0.005 deg, is neglected
    sidereal = np.radians((280.46061837 + 360.98564736629 * days + longitude_deg) % 360.0)
    hour = sidereal - right_ascension
    latitude = np.radians(latitude_deg)
    elevation = np.arcsin(
        np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(hour)
    )
    east = -np.cos(declination) * np.sin(hour)
    north = np.sin(declination) * np.cos(latitude) - np.cos(declination) * np.sin(latitude) * np.cos(hour)
    return direction(float(np.arctan2(east, north)), float(elevation))
