"""Readers of calibrations that are not YAML: OpenCV's XML, COLMAP's `cameras.txt`, Ames Stereo Pipeline's pinholes.

Each is converted to the names of OpenCV's YAML files (`camera_matrix`, `distortion_coefficients`, `image_width`,
`image_height`), which `marsyard.sim.camera.calibrations` reads. COLMAP counts pixels from the corner of the image:
0.5 is subtracted from its principal point. Files of Ames Stereo Pipeline do not contain the image's size.
"""

import re
from collections.abc import Mapping
from typing import Any

from marsyard.sim.camera.file_reading import CALIBRATION_FILES, Source, parse_xml

Values = Mapping[str, Any]

#: Root element of OpenCV's files.
OPENCV_ROOT = "opencv_storage"
#: First line of a camera in COLMAP's file, after comments; start of a camera of Ames Stereo Pipeline.
COLMAP = re.compile(rb"\A(?:\s*#[^\n]*\n|\s*\n)*\s*\d+\s+[A-Z][A-Z_]+\s+\d+\s+\d+\s+[-+.\d]")
STEREO_PIPELINE = re.compile(rb"\A\s*VERSION_\d+\s+PINHOLE\b")
#: Names of the parameters of COLMAP's models, and whether the model is a fisheye's.
_COLMAP_MODELS: dict[str, tuple[str, bool]] = {
    "SIMPLE_PINHOLE": ("f cx cy", False),
    "PINHOLE": ("fx fy cx cy", False),
    "SIMPLE_RADIAL": ("f cx cy k1", False),
    "RADIAL": ("f cx cy k1 k2", False),
    "OPENCV": ("fx fy cx cy k1 k2 p1 p2", False),
    "FULL_OPENCV": ("fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6", False),
    "SIMPLE_RADIAL_FISHEYE": ("f cx cy k1", True),
    "RADIAL_FISHEYE": ("f cx cy k1 k2", True),
    "OPENCV_FISHEYE": ("fx fy cx cy k1 k2 k3 k4", True),
}
#: Axes of the image of Ames Stereo Pipeline that are OpenCV's.
_AXES = {"u_direction": (1.0, 0.0, 0.0), "v_direction": (0.0, 1.0, 0.0), "w_direction": (0.0, 0.0, 1.0)}
_ASSIGNMENT = re.compile(r"^\s*(?P<name>\w+)\s*=\s*(?P<value>.*?)\s*$")


def read_opencv_xml(source: Source) -> Values:
    """Read the values of OpenCV's XML. Raises CameraFileError."""
    values: dict[str, Any] = {}
    for element in parse_xml(source, CALIBRATION_FILES):
        data, text = element.find("data"), (element.text or "").strip()
        if data is not None:
            values[element.tag] = {"data": (data.text or "").split()}
        else:
            values[element.tag] = int(text) if text.isdecimal() else text
    return values


def read_colmap(source: Source) -> list[tuple[str, Values]]:
    """Read the cameras of COLMAP's `cameras.txt`, in order, with their identifiers. Raises CameraFileError."""
    cameras: list[tuple[str, Values]] = []
    for number, line in enumerate(source.read_text().splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        field = f"line {number}"
        if len(words) < 4 or words[1] not in _COLMAP_MODELS:
            model = words[1] if len(words) > 1 else ""
            raise source.error(field, f"the camera model is {model!r}", ", ".join(_COLMAP_MODELS))
        names, is_fisheye = _COLMAP_MODELS[words[1]]
        if len(words) != 4 + len(names.split()) or not all(word.isdecimal() for word in words[2:4]):
            raise source.error(field, f"has {len(words)} words", f"identifier, model, width, height, {names}")
        numbers = _parse_numbers(source, field, words[4:])
        terms = dict(zip(names.split(), numbers, strict=True))
        order = "k1 k2 k3 k4" if is_fisheye else "k1 k2 p1 p2 k3 k4 k5 k6"
        values = {
            "camera_matrix": _matrix(
                terms.get("fx", terms.get("f", 0.0)),
                terms.get("fy", terms.get("f", 0.0)),
                terms["cx"] - 0.5,
                terms["cy"] - 0.5,
            ),
            "distortion_coefficients": [terms.get(name, 0.0) for name in order.split()],
            "distortion_model": "equidistant" if is_fisheye else "rational_polynomial",
            "image_width": int(words[2]),
            "image_height": int(words[3]),
        }
        cameras.append((words[0], values))
    return cameras


def read_stereo_pipeline(source: Source, size: tuple[int, int] | None) -> Values:
    """Read a pinhole model of Ames Stereo Pipeline with the lens models NULL and TSAI; its pose is ignored.

    The lens model TSAI is OpenCV's. `size` is (columns, rows) of the image. Raises CameraFileError.
    """
    terms: dict[str, str] = {}
    lens = "NULL"
    for line in source.read_text().partition("PINHOLE")[2].splitlines():
        match = _ASSIGNMENT.match(line)
        if match is not None:
            terms[match["name"]] = match["value"]
        elif line.strip():
            lens = line.strip()
    if lens not in ("NULL", "TSAI"):
        raise source.error("lens model", f"{lens!r}", "NULL or TSAI")
    if size is None:
        raise source.error("size", "missing: the file does not contain it", "size = [columns, rows]")
    for name, axis in _AXES.items():
        if tuple(_parse_numbers(source, name, terms.get(name, "").split())) != axis:
            raise source.error(name, f"{terms.get(name, 'missing')!r}", " ".join(f"{number:g}" for number in axis))

    def read_number(name: str, default: str = "") -> float:
        numbers = _parse_numbers(source, name, terms.get(name, default).split())
        if len(numbers) != 1:
            raise source.error(name, f"{terms.get(name, 'missing')!r}", "a number")
        return numbers[0]

    pitch = read_number("pitch")
    if pitch <= 0.0:
        raise source.error("pitch", f"{pitch:g}", "the size of a pixel, above 0")
    coefficients = [read_number(name, "0") for name in ("k1", "k2", "p1", "p2", "k3")] if lens == "TSAI" else []
    return {
        "camera_matrix": _matrix(*(read_number(name) / pitch for name in ("fu", "fv", "cu", "cv"))),
        "distortion_coefficients": coefficients,
        "image_width": size[0],
        "image_height": size[1],
    }


def _matrix(fx: float, fy: float, cx: float, cy: float) -> list[list[float]]:
    return [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]


def _parse_numbers(source: Source, field: str, words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise source.error(field, str(error), "numbers") from error
