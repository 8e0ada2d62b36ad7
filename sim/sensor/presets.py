"""Camera presets: geometry, light path and detector of the cameras in the papers.

A descent camera is defined in the body frame: at its origin, looking along -z, columns along +x. All other cameras are
defined in the frame of the mast or rover: x forward, y left, z up, with its origin between the two cameras of a pair.
``camera.transform(body_from_mast)`` mounts them on a vehicle.

Sources; assumed values are marked:

- MER descent camera: Johnson, Willson, Goguen, Alexander & Meller 2005, "Field Testing of the Mars Exploration Rovers
  Descent Image Motion Estimation System", IEEE ICRA, section III.B (the field-test paper)
- research rover: Kim et al. 2009, "Targeted Driving Using Visual Tracking on Mars: From Research to Flight", Journal of
  Field Robotics 26(3), section 3 (the target tracking paper)
- XC-55 of the helicopter: Johnson, Montgomery & Matthies 2005, "Vision Guided Landing of an Autonomous Helicopter in
  Hazardous Terrain", IEEE ICRA, section 5 (the landing paper)
- all MER cameras: Maki et al. 2003, "Mars Exploration Rover Engineering Cameras", Journal of Geophysical Research
  108(E12), 8071
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.sim.camera import Cahv, Cahvor, Cahvore, CameraModel
from marsyard.sim.sensor.detector import DetectorParameters
from marsyard.sim.sensor.optics import OpticsParameters
from marsyard.sim.sensor.radiometry import DARK_E_S, NG3_FIELD, NG4_FLIGHT, LightPath, bright_exposure_s

#: Distance of Mars from the sun at the MER landings ("1.5 AU" in the paper: 44 % of the sunlight at Earth), AU.
MARS_AU = 1.5
NAVCAM_RADIAL = (0.00096, -0.002183, 0.018547)  #: Distortion of Opportunity's left navcam (its PDS label), R of CAHVOR.
#: Barrel distortion of a small C-mount lens, R of CAHVOR: 1.8 % in the image corner of the XC-55; assumed.
C_MOUNT_RADIAL = (0.0, -0.08, 0.025)


@dataclass(frozen=True)
class CameraDesign:
    """Design geometry of a camera or of a stereo pair, from which camera models are created.

    - size: (columns, rows)
    - radial: R of CAHVOR or CAHVORE
    - linearity: parameter of CAHVORE; None for CAHVOR
    - baseline_m: distance between the cameras of a pair; None for a single camera
    - toe_in_deg: inward rotation of each camera of a pair
    - down: whether the camera looks down along -z instead of forward along +x
    """

    focal_length_mm: float
    pixel_pitch_um: float
    size: tuple[int, int]
    radial: tuple[float, float, float] = (0.0, 0.0, 0.0)
    linearity: float | None = None
    baseline_m: float | None = None
    toe_in_deg: float = 0.0
    down: bool = False

    def cameras(self) -> tuple[CameraModel, ...]:
        """Create the camera, or the left and the right camera of the pair."""
        if self.baseline_m is None:
            return (self._create_camera(0.0, 0.0),)
        left_m, toe_in = 0.5 * self.baseline_m, np.radians(self.toe_in_deg)
        return (self._create_camera(left_m, -toe_in), self._create_camera(-left_m, toe_in))

    def _create_camera(self, left_m: float, azimuth_rad: float) -> CameraModel:
        rotation = Rotation.from_rotvec([0.0, 0.0, azimuth_rad])
        pinhole = Cahv.from_focal_length(
            focal_m=self.focal_length_mm * 1e-3,
            pixel_pitch_m=self.pixel_pitch_um * 1e-6,
            size=self.size,
            centre=np.array([0.0, left_m, 0.0]),
            axis=np.array([0.0, 0.0, -1.0]) if self.down else rotation.apply([1.0, 0.0, 0.0]),
            right=np.array([1.0, 0.0, 0.0]) if self.down else rotation.apply([0.0, -1.0, 0.0]),
        )
        if self.linearity is None:
            return Cahvor.from_cahv(pinhole, r=np.array(self.radial))
        return Cahvore.from_cahv(pinhole, r=np.array(self.radial), linearity=self.linearity)


@dataclass(frozen=True)
class Preset:
    """A camera or stereo pair of the papers: geometry, light path and detector."""

    design: CameraDesign
    light: LightPath
    detector: DetectorParameters

    def cameras(self) -> tuple[CameraModel, ...]:
        """Create the camera, or the left and the right camera of a pair."""
        return self.design.cameras()


def _create_mer_preset(design: CameraDesign, light: LightPath, sun_au: float, **changes: float | int) -> Preset:
    """Create a camera with the MER detector: the defaults of `DetectorParameters` with these changes."""
    values = {
        "responsivity_e_s": light.responsivity_e_s(sun_au),
        "sun_au": sun_au,
        "dark_e_s": DARK_E_S,
        "optics": OpticsParameters(diffraction_px=light.diffraction_px()),
    }
    return Preset(design, light, DetectorParameters.model_validate(values | changes))


#: RMS of the pattern in the flown descent camera's images that its calibration lacks.
FLIGHT_RESIDUAL = 0.01
#: MER descent camera: focal length 14.67 mm, pixel pitch 12 um.
_DESCENT = CameraDesign(focal_length_mm=14.67, pixel_pitch_um=12.0, size=(1024, 1024), radial=NAVCAM_RADIAL, down=True)
#: F-number of the MER descent camera and navcam, and of the hazcam (Maki et al. 2003).
_DESCENT_F_NUMBER, _NAVCAM_F_NUMBER, _HAZCAM_F_NUMBER = 12.0, 12.0, 15.0
_FLIGHT_EXPOSURE_S = 0.004
_DESCENT_BAND, _ROVER_BAND = (400.0, 1100.0), (600.0, 800.0)  #: Passbands (Maki et al. 2003), nm.


def _descent_light(neutral_density: float) -> LightPath:
    """Create the light path of the MER descent camera behind a filter of this optical density."""
    return LightPath(
        f_number=_DESCENT_F_NUMBER,
        pixel_pitch_um=_DESCENT.pixel_pitch_um,
        band_nm=_DESCENT_BAND,
        neutral_density=neutral_density,
    )


def _create_mer_descent_flown() -> Preset:
    light = _descent_light(neutral_density=NG4_FLIGHT)
    # the pattern is calibrated: pairs of rendered images differ as much as pairs of Spirit's
    changes = {"exposure_s": _FLIGHT_EXPOSURE_S, "temperature_c": -34.0, "residual_spread": FLIGHT_RESIDUAL}
    return _create_mer_preset(_DESCENT, light, MARS_AU, **changes)


def _create_mer_descent_field() -> Preset:
    """Create the camera of the field test, with the exposure time scaled to the same signal electrons as in flight."""
    light = _descent_light(neutral_density=NG3_FIELD)
    flight_responsivity = _create_mer_descent_flown().detector.responsivity_e_s
    exposure = _FLIGHT_EXPOSURE_S * flight_responsivity / light.responsivity_e_s(1.0)
    return _create_mer_preset(_DESCENT, light, 1.0, exposure_s=exposure, temperature_c=0.0)


def _create_mer_rover(design: CameraDesign, f_number: float) -> Preset:
    """Create an MER rover camera with a full well of 170000 e; rows are not summed, the temperature is assumed."""
    light = LightPath(f_number=f_number, pixel_pitch_um=design.pixel_pitch_um, band_nm=_ROVER_BAND)
    exposure = bright_exposure_s(full_well_e=170000.0, responsivity_e_s=light.responsivity_e_s(MARS_AU))
    return _create_mer_preset(design, light, MARS_AU, exposure_s=exposure, temperature_c=-40.0, rows_summed=1)


#: Assumed: counts of an interline CCD without light, as a fraction of its range (4 of 256). The read noise is 0.2
#: counts with 8 bits and 1.2 counts with 10 bits, so 0 does not clip it.
_BLACK_LEVEL = 1.0 / 64.0


def _create_interline_preset(design: CameraDesign, full_well_e: float, bits: int) -> Preset:
    """Create an interline CCD without smear, on Earth at +20 deg C, 15 images/s. Assumed: f/4, passband, noise."""
    light = LightPath(f_number=4.0, pixel_pitch_um=design.pixel_pitch_um, band_nm=(400.0, 700.0))
    responsivity = light.responsivity_e_s(1.0)
    detector = DetectorParameters(
        exposure_s=bright_exposure_s(full_well_e, responsivity),
        responsivity_e_s=responsivity,
        sun_au=1.0,
        rows_summed=1,
        transfer_row_s=0.0,
        clear_row_s=0.0,
        readout_row_s=1.0 / 15.0 / design.size[1],
        full_well_e=full_well_e,
        gain_e_dn=full_well_e / 2**bits,
        read_noise_e=15.0,
        offset_dn=_BLACK_LEVEL * 2**bits,
        bits=bits,
        temperature_c=20.0,
        # in proportion to the area: `DARK_E_S` is that of a pixel of 12 um
        dark_e_s=DARK_E_S * (design.pixel_pitch_um / 12.0) ** 2,
        optics=OpticsParameters(diffraction_px=light.diffraction_px()),
    )
    return Preset(design, light, detector)


PRESETS: Mapping[str, Callable[[], Preset]] = {
    "mer-descent-flown": _create_mer_descent_flown,
    "mer-descent-field": _create_mer_descent_field,
    "mer-navcam": partial(
        _create_mer_rover,
        CameraDesign(
            focal_length_mm=14.67, pixel_pitch_um=12.0, size=(1024, 1024), radial=NAVCAM_RADIAL, baseline_m=0.20
        ),
        f_number=_NAVCAM_F_NUMBER,
    ),
    # assumed: equidistant fisheye without distortion, with a fixed pupil
    "mer-hazcam": partial(
        _create_mer_rover,
        CameraDesign(focal_length_mm=5.58, pixel_pitch_um=12.0, size=(1024, 1024), linearity=0.0, baseline_m=0.10),
        f_number=_HAZCAM_F_NUMBER,
    ),
    "research-navcam": partial(
        _create_interline_preset,
        CameraDesign(focal_length_mm=6.0, pixel_pitch_um=4.65, size=(1024, 768), baseline_m=0.20),
        full_well_e=13000.0,
        bits=10,
    ),
    # assumed: toe-in of the MER pancams; parallel cameras have a disparity of 516 px at 2 m
    "research-pancam": partial(
        _create_interline_preset,
        CameraDesign(focal_length_mm=16.0, pixel_pitch_um=4.65, size=(1024, 768), baseline_m=0.30, toe_in_deg=1.0),
        full_well_e=13000.0,
        bits=10,
    ),
    # assumed: 6 mm lens, 43 deg, with some distortion
    "xc-55": partial(
        _create_interline_preset,
        CameraDesign(focal_length_mm=6.0, pixel_pitch_um=7.4, size=(640, 480), radial=C_MOUNT_RADIAL, down=True),
        full_well_e=20000.0,
        bits=8,
    ),
}


@cache
def preset(name: str) -> Preset:
    """Create a camera preset by name. Raises ValueError if it is unknown."""
    if name not in PRESETS:
        raise ValueError(f"unknown camera preset {name!r}; allowed: {', '.join(PRESETS)}")
    return PRESETS[name]()
