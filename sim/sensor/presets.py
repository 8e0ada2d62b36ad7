"""Camera presets (geometry and detector of the cameras in the papers), detector datasheets, and custom cameras.

A descent camera is defined in the body frame: at its origin, looking along -z, columns along +x. All other cameras are
defined in the frame of the mast or rover: x forward, y left, z up, with its origin between the two cameras of a pair.
``camera.transform(body_from_mast)`` mounts them on a vehicle.

Sources: the field-test paper III.B; the target tracking paper section 3 (research rover); the landing paper section 5;
Maki et al. 2003, "Mars Exploration Rover Engineering Cameras" (MER). Assumed values are marked.

Datasheets are TOML files with values of the manufacturer (those of EMVA 1288: saturation capacity, temporal dark noise,
quantum efficiency, dark current, photo response non-uniformity) and the lens in front of the detector: see `Datasheet`.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, ValidationError, model_validator
from scipy.spatial.transform import Rotation

from marsyard.sim.camera import Cahv, Cahvor, Cahvore, CameraModel, mount_looking_down, read_cameras
from marsyard.sim.files import open_regular
from marsyard.sim.parameters import NonNegative, Parameters, Positive, merge_parameters
from marsyard.sim.sensor import optics
from marsyard.sim.sensor.detector import DetectorParameters
from marsyard.sim.sensor.optics import LENS_TRANSMISSION, LightPath, OpticsParameters, bright_exposure_s

#: Distance of Mars from the sun at the MER landings ("1.5 AU" in the paper: 44 % of the sunlight at Earth), AU.
MARS_AU = 1.5
NAVCAM_RADIAL = (0.00096, -0.002183, 0.018547)  #: Distortion of Opportunity's left navcam (its PDS label), R of CAHVOR.
#: Barrel distortion of a small C-mount lens, R of CAHVOR: 1.8 % in the image corner of the XC-55; assumed.
C_MOUNT_RADIAL = (0.0, -0.08, 0.025)
_MAX_BYTES = 1 << 20  #: Maximum size of a datasheet.


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
        "dark_e_s": optics.DARK_E_S,
        "optics": OpticsParameters(diffraction_px=light.diffraction_px()),
    }
    return Preset(design, light, DetectorParameters.model_validate(values | changes))


#: RMS of the pattern in the flown descent camera's images that its calibration lacks.
_FLIGHT_RESIDUAL = 0.01
#: MER descent camera: focal length 14.67 mm, pixel pitch 12 um.
_DESCENT = CameraDesign(14.67, 12.0, (1024, 1024), NAVCAM_RADIAL, down=True)
_FLIGHT_EXPOSURE_S = 0.004
_DESCENT_BAND, _ROVER_BAND = (400.0, 1100.0), (600.0, 800.0)  #: Passbands (Maki et al. 2003), nm.


def _create_mer_descent_flown() -> Preset:
    light = LightPath(12.0, 12.0, _DESCENT_BAND, optics.NG4_FLIGHT)
    # the pattern is calibrated: pairs of rendered images differ as much as pairs of Spirit's
    changes = {"exposure_s": _FLIGHT_EXPOSURE_S, "temperature_c": -34.0, "residual_spread": _FLIGHT_RESIDUAL}
    return _create_mer_preset(_DESCENT, light, MARS_AU, **changes)


def _create_mer_descent_field() -> Preset:
    """Create the camera of the field test, with the exposure time scaled to the same signal electrons as in flight."""
    light = LightPath(12.0, 12.0, _DESCENT_BAND, optics.NG3_FIELD)
    flight_responsivity = _create_mer_descent_flown().detector.responsivity_e_s
    exposure = _FLIGHT_EXPOSURE_S * flight_responsivity / light.responsivity_e_s(1.0)
    return _create_mer_preset(_DESCENT, light, 1.0, exposure_s=exposure, temperature_c=0.0)


def _create_mer_rover(design: CameraDesign, f_number: float) -> Preset:
    """Create an MER rover camera with a full well of 170000 e; rows are not summed, the temperature is assumed."""
    light = LightPath(f_number, design.pixel_pitch_um, _ROVER_BAND)
    exposure = bright_exposure_s(170000.0, light.responsivity_e_s(MARS_AU))
    return _create_mer_preset(design, light, MARS_AU, exposure_s=exposure, temperature_c=-40.0, rows_summed=1)


def _create_interline_preset(design: CameraDesign, full_well_e: float, bits: int) -> Preset:
    """Create an interline CCD without smear, on Earth at +20 deg C, 15 images/s. Assumed: f/4, passband, noise."""
    light = LightPath(4.0, design.pixel_pitch_um, (400.0, 700.0))
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
        offset_dn=4.0 * 2 ** (bits - 8),
        bits=bits,
        temperature_c=20.0,
        dark_e_s=optics.DARK_E_S * (design.pixel_pitch_um / 12.0) ** 2,
        optics=OpticsParameters(diffraction_px=light.diffraction_px()),
    )
    return Preset(design, light, detector)


PRESETS: Mapping[str, Callable[[], Preset]] = {
    "mer-descent-flown": _create_mer_descent_flown,
    "mer-descent-field": _create_mer_descent_field,
    "mer-navcam": partial(
        _create_mer_rover, CameraDesign(14.67, 12.0, (1024, 1024), NAVCAM_RADIAL, baseline_m=0.20), 12.0
    ),
    # assumed: equidistant fisheye without distortion, with a fixed pupil
    "mer-hazcam": partial(
        _create_mer_rover, CameraDesign(5.58, 12.0, (1024, 1024), linearity=0.0, baseline_m=0.10), 15.0
    ),
    "research-navcam": partial(
        _create_interline_preset, CameraDesign(6.0, 4.65, (1024, 768), baseline_m=0.20), 13000.0, 10
    ),
    # assumed: toe-in of the MER pancams; parallel cameras have a disparity of 516 px at 2 m
    "research-pancam": partial(
        _create_interline_preset, CameraDesign(16.0, 4.65, (1024, 768), baseline_m=0.30, toe_in_deg=1.0), 13000.0, 10
    ),
    # assumed: 6 mm lens, 43 deg, with some distortion
    "xc-55": partial(
        _create_interline_preset, CameraDesign(6.0, 7.4, (640, 480), C_MOUNT_RADIAL, down=True), 20000.0, 8
    ),
}


@cache
def preset(name: str) -> Preset:
    """Create a camera preset by name. Raises ValueError if it is unknown."""
    if name not in PRESETS:
        raise ValueError(f"unknown camera preset {name!r}; allowed: {', '.join(PRESETS)}")
    return PRESETS[name]()


class QuantumEfficiency(Parameters):
    """Electrons per photon by wavelength, interpolated linearly, zero outside."""

    wavelength_nm: Annotated[tuple[float, ...], Field(min_length=2)]
    efficiency: Annotated[tuple[Annotated[float, Field(ge=0.0, le=1.0)], ...], Field(min_length=2)]

    @model_validator(mode="after")
    def _check_curve(self) -> QuantumEfficiency:
        if len(self.wavelength_nm) != len(self.efficiency):
            counts = f"{len(self.wavelength_nm)} wavelengths and {len(self.efficiency)} efficiencies"
            raise ValueError(f"{counts}; both lists must have the same length")
        if np.any(np.diff(self.wavelength_nm) <= 0.0):
            raise ValueError("wavelength_nm must increase")
        return self


class Lens(Parameters):
    """The lens in front of the detector."""

    f_number: Annotated[float, Field(gt=0.0, le=100.0)]
    band_nm: Annotated[tuple[Positive, Positive], Field(description="first and last wavelength of the passband")]
    transmission: Annotated[float, Field(gt=0.0, le=1.0, description="lens and filters")] = LENS_TRANSMISSION

    @model_validator(mode="after")
    def _check_band(self) -> Lens:
        if not 200.0 <= self.band_nm[0] < self.band_nm[1] <= 2500.0:
            raise ValueError(f"band_nm is {list(self.band_nm)}; allowed: two increasing wavelengths, 200 to 2500 nm")
        return self


class Datasheet(Parameters):
    """Values of a detector's datasheet and of its lens; they define `DetectorParameters`."""

    name: str = ""
    pixel_pitch_um: Annotated[float, Field(gt=0.1, le=100.0)]
    full_well_e: Annotated[Positive, Field(description="saturation capacity, electrons")]
    read_noise_e: Annotated[NonNegative, Field(description="temporal dark noise, electrons")]
    bits: Annotated[int, Field(ge=8, le=16)]
    gain_e_dn: Annotated[Positive | None, Field(description="electrons per count; default: full well / 2^bits")] = None
    black_level_dn: NonNegative = 0.0
    quantum_efficiency: Annotated[float, Field(gt=0.0, le=1.0)] | QuantumEfficiency
    dark_current_e_s: Annotated[NonNegative, Field(description="per pixel at dark_temperature_c, electrons/s")]
    dark_temperature_c: Annotated[float, Field(ge=-150.0, le=100.0)]
    dark_doubling_c: Annotated[float, Field(gt=0.0, le=50.0)] = 6.0
    temperature_c: Annotated[float | None, Field(ge=-150.0, le=80.0, description="default: dark_temperature_c")] = None
    prnu: Annotated[float, Field(ge=0.0, le=0.1, description="RMS of the relative pixel response")] = 0.01
    shutter: Annotated[Literal["global", "frame-transfer"], Field(description="rolling is not supported")] = "global"
    transfer_row_s: Annotated[NonNegative, Field(description="frame transfer: shift time per row")] = 0.0
    rows: Annotated[int, Field(ge=16, le=16384, description="rows of a frame")]
    readout_s: Annotated[NonNegative, Field(description="readout time of a frame, s")]
    exposure_s: Annotated[float | None, Field(gt=0.0, le=10.0, description="default: 60 % of full well at I/F 0.3")] = (
        None
    )
    sun_au: Annotated[float, Field(gt=0.1, le=100.0, description="distance from the sun; sets exposure_s")] = 1.5
    lens: Lens

    @model_validator(mode="after")
    def _check_shutter(self) -> Datasheet:
        if (self.shutter == "frame-transfer") != (self.transfer_row_s > 0.0):
            raise ValueError("transfer_row_s must be above 0 for the shutter 'frame-transfer', and 0 otherwise")
        return self

    def light(self) -> LightPath:
        """Create the light path from the sun to electrons."""
        q, lens = self.quantum_efficiency, self.lens
        curve = (lens.band_nm, (q, q)) if isinstance(q, float) else (q.wavelength_nm, q.efficiency)
        return LightPath(lens.f_number, self.pixel_pitch_um, lens.band_nm, None, lens.transmission, curve)

    def parameters(self) -> DetectorParameters:
        """Create the parameters of the simulated detector, which reads out all pixels."""
        light = self.light()
        responsivity = light.responsivity_e_s(self.sun_au)
        common_fields = {"sun_au", "transfer_row_s", "full_well_e", "read_noise_e", "bits", "dark_doubling_c"}
        return DetectorParameters(
            **self.model_dump(include=common_fields),
            exposure_s=self.exposure_s or bright_exposure_s(self.full_well_e, responsivity),
            responsivity_e_s=responsivity,
            rows_summed=1,
            clear_row_s=0.0,
            readout_row_s=self.readout_s / self.rows,
            gain_e_dn=self.full_well_e / 2**self.bits if self.gain_e_dn is None else self.gain_e_dn,
            offset_dn=self.black_level_dn,
            temperature_c=self.dark_temperature_c if self.temperature_c is None else self.temperature_c,
            dark_e_s=self.dark_current_e_s * 2.0 ** (-self.dark_temperature_c / self.dark_doubling_c),
            response_spread=self.prnu,
            optics=OpticsParameters(diffraction_px=light.diffraction_px()),
        )


def read_datasheet(path: str | Path) -> Datasheet:
    """Read a datasheet from a TOML file; raises ValueError with file and field if it cannot be read or is not valid."""
    try:
        with open_regular(path) as file:
            contents = file.read(_MAX_BYTES + 1)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from error
    if len(contents) > _MAX_BYTES:
        raise ValueError(f"{path}: larger than {_MAX_BYTES >> 20} MiB; expected a datasheet in TOML")
    try:
        values: dict[str, Any] = tomllib.loads(contents.decode("utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not valid TOML ({error})") from error
    try:
        return Datasheet.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "datasheet"
        raise ValueError(f"{path}: {key}: {first['msg'].removeprefix('Value error, ')}") from error


def _resolve_detector(values: object) -> object:
    """Merge values with those of the selected preset or datasheet, if there is one."""
    if isinstance(values, str):
        values = {"file": values} if values.endswith(".toml") else {"preset": values}
    if not isinstance(values, Mapping) or all(values.get(key) is None for key in ("preset", "file")):
        return values
    if set(DetectorParameters.model_fields) <= set(values):  # already resolved: values stored with a campaign
        return values
    if {"preset", "file"} <= set(values):
        raise ValueError("a detector is defined by a preset or by a datasheet file, not both")
    changes = {key: value for key, value in values.items() if key not in ("preset", "file")}
    if "file" in values:
        file = str(values["file"])
        return merge_parameters({**read_datasheet(file).parameters().model_dump(), "file": file}, changes)
    return merge_parameters(preset(str(values["preset"])).detector.model_dump(), changes)


#: Detector parameters of a campaign, defined by values or by changes to a preset or datasheet:
#: ``[parameters.detector]`` with ``preset = "mer-descent-field"`` and, for example, ``temperature_c = 23.0``; or
#: ``file = "sensor.toml"``.
DetectorChoice = Annotated[DetectorParameters, BeforeValidator(_resolve_detector)]


Vector = tuple[float, float, float]
#: Keys of a custom camera that is read from a file.
_FILE_KEYS = ("file", "number", "subframe_folded_in", "size")


class CustomCamera(Parameters):
    """A camera of the CAHV family in the body frame: at its origin, looking along -z, columns along +x.

    Defined by ``{ file = "camera.yaml" }`` (any format of `marsyard.sim.camera.read_cameras`) or by the path; the other
    fields are then read from the file. The camera is mounted with A pointing down, independent of its pose in the file.
    """

    file: Annotated[str | None, Field(description="camera file that the model was read from")] = None
    number: Annotated[int, Field(ge=0, description="index of the camera in the file, from 0")] = 0
    subframe_folded_in: Annotated[bool, Field(description="accept PDS labels of subframes")] = False
    model: Annotated[Literal["CAHV", "CAHVOR", "CAHVORE"], Field(description="type of the model, read from the file")]
    columns: Annotated[int, Field(ge=16, le=16384)]
    rows: Annotated[int, Field(ge=16, le=16384)]
    h: Annotated[Vector, Field(description="horizontal image vector, pixels")]
    v: Annotated[Vector, Field(description="vertical image vector, pixels")]
    o: Annotated[Vector | None, Field(description="optical axis, unit vector")] = None
    r: Annotated[Vector | None, Field(description="radial distortion")] = None
    e: Annotated[Vector | None, Field(description="entrance pupil shift coefficients, m")] = None
    linearity: Annotated[float | None, Field(description="parameter of CAHVORE")] = None

    @model_validator(mode="after")
    def _check_camera(self) -> CustomCamera:
        self.camera()
        return self

    def camera(self) -> CameraModel:
        """Create the camera in the body frame. Raises ValueError if a vector is missing."""
        pinhole = Cahv(np.zeros(3), np.array([0.0, 0.0, -1.0]), np.array(self.h), np.array(self.v), self.size)
        if self.model == "CAHV":
            return pinhole
        if self.o is None or self.r is None:
            raise ValueError(f"{self.model} requires o and r")
        if self.model == "CAHVOR":
            return Cahvor.from_cahv(pinhole, r=np.array(self.r), o=np.array(self.o))
        if self.e is None or self.linearity is None:
            raise ValueError("CAHVORE requires e and linearity")
        r, e, o = (np.array(vector) for vector in (self.r, self.e, self.o))
        return Cahvore.from_cahv(pinhole, r, e, linearity=self.linearity, o=o)

    def input_files(self) -> tuple[str, ...]:
        """Return the file that the camera was read from."""
        return () if self.file is None else (self.file,)

    @property
    def size(self) -> tuple[int, int]:
        """Image size (columns, rows)."""
        return self.columns, self.rows

    @classmethod
    def from_camera(cls, camera: CameraModel, **origin: Any) -> CustomCamera:
        """Create the parameters from a camera with any pose, mounted to look down; `origin`: fields of the file."""
        model = mount_looking_down(camera)
        length = float(np.linalg.norm(model.a))  # A in PDS labels is rounded and not exactly a unit vector
        vectors: dict[str, Any] = {
            letter: tuple((getattr(model, letter) / (length if letter in "hv" else 1.0)).tolist())
            for letter in "hvore"
            if hasattr(model, letter)
        }
        values = {"columns": model.size[0], "rows": model.size[1], "linearity": getattr(model, "linearity", None)}
        # class names equal model names
        return cls.model_validate({"model": type(model).__name__.upper(), **values, **vectors, **origin})


def _resolve_camera(values: object) -> object:
    """Read the camera file if the values contain one; return other values unchanged."""
    if isinstance(values, str | Path):
        values = {"file": str(values)}
    if not isinstance(values, Mapping) or "model" in values or not isinstance(values.get("file"), str | Path):
        return values
    unknown = [name for name in values if name not in _FILE_KEYS]
    if unknown:
        raise ValueError(f"unknown key {unknown[0]} for a camera file; allowed: {', '.join(_FILE_KEYS)}")
    path, number, folded = str(values["file"]), values.get("number", 0), values.get("subframe_folded_in", False)
    size = values.get("size")
    if size is not None and not (isinstance(size, list | tuple) and [type(value) for value in size] == [int, int]):
        raise ValueError(f"{path}: size is {size!r}; allowed: [columns, rows]")
    cameras = read_cameras(path, subframe_folded_in=bool(folded), size=None if size is None else (size[0], size[1]))
    if not (isinstance(number, int) and 0 <= number < len(cameras)):
        raise ValueError(f"{path}: number is {number!r}; allowed: 0 to {len(cameras) - 1}")
    if len(cameras) > 1 and "number" not in values:
        raise ValueError(f"{path}: contains {len(cameras)} cameras; set number, 0 to {len(cameras) - 1}")
    return CustomCamera.from_camera(cameras[number], file=path, number=number, subframe_folded_in=bool(folded))


def _resolve_camera_or_preset(value: object) -> object:
    """Return the name of a preset unchanged; read the camera file if the text has a suffix or a folder."""
    return value if isinstance(value, str) and not Path(value).suffix and "/" not in value else _resolve_camera(value)


#: Custom camera in a campaign; and custom camera or name of a preset.
CustomCameraChoice = Annotated[CustomCamera, BeforeValidator(_resolve_camera)]
NamedOrCustomCamera = Annotated[str | CustomCamera, BeforeValidator(_resolve_camera_or_preset)]
