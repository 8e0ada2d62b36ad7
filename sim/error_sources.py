"""Sources of error, as marks on the parameters of the instruments and models that have them.

An error budget removes the sources of a scenario one by one. A source consists of all parameters with its mark::

    gyro_bias_deg_h: Annotated[NonNegative, ATTITUDE, Field(description="constant gyro bias, deg/h")] = 1.0

A mark on a whole table replaces the marks inside. A table that may be absent is itself the parameter.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class ErrorSource:
    """A source of error.

    - name: short name, unique in a scenario; title: noun phrase for tables and figures
    - remaining: factor by which numeric parameters are multiplied to remove the error. It is 0 in general, and above 0
      if the on-board filter is tuned with the same parameter: with 0 the filter would assume a perfect sensor
    """

    name: str
    title: str
    remaining: float = 0.0


ATTITUDE = ErrorSource("attitude", "attitude and gyroscopes")
ACCELERATION = ErrorSource("acceleration", "velocity and accelerometers")
INERTIAL = ErrorSource("inertial", "inertial measurement unit", remaining=0.1)
ALTITUDE = ErrorSource("altitude", "altimeter: scale, noise, boresight")
SIDE_LOBES = ErrorSource("side-lobes", "radar altimeter: side lobes")
RECEIVER = ErrorSource("receiver", "GPS receiver")
COMPASS = ErrorSource("compass", "compass: tilt and heading")
TIME_TAGS = ErrorSource("time-tags", "time tags")
CALIBRATION = ErrorSource("calibration", "camera calibration and alignment")
DETECTOR = ErrorSource("detector", "detector: noise, response, defects")
OPTICS = ErrorSource("optics", "optics: defocus, stray light, dust")
CLOUDS = ErrorSource("clouds", "clouds")
SHADOW = ErrorSource("shadow", "shadow of the vehicle")
GUSTS = ErrorSource("gusts", "gusts: change of velocity between images")
SWING = ErrorSource("swing", "swing: coning, nodding, spin")
WIND = ErrorSource("wind", "wind and gusts")
VIBRATION = ErrorSource("vibration", "vibration")
ODOMETRY = ErrorSource("odometry", "wheel odometry, heading, tilt")
SLIP = ErrorSource("slip", "slip")
POINTING = ErrorSource("pointing", "mast pointing")
STEREO = ErrorSource("stereo", "stereo calibration")
