"""Reader and writer of the text files of JPL's programs CCALADJ and cmod (.cahv, .cahvor, .cahvore).

A file contains

    Model = CAHVOR = perspective, distortion
    Dimensions = 1024 1024
    C =  0.442604 -0.0611635 -1.25106
    A = ...

and likewise the model's other vectors H, V, O, R, E. The line Model of CAHVORE contains its type (1 perspective, 2
fish-eye, 3 general) and for type 3 the linearity: ``Model = CAHVORE3,0.37 = general``. The reader ignores the derived
values Hs, Hc, Vs, Vc and Theta, the covariance matrices ``S`` and ``S internal``, and unknown lines.
"""

import math
import re
from pathlib import Path

from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.cahvore import Cahvore
from marsyard.sim.camera.file_reading import FORMATS, Source, create_camera, linearity_of_type

#: Names of lines in a JPL text file, of which a file in this format has at least one.
_LINES = ("Model", "Dimensions", "C", "A", "H", "V")
#: Descriptions of the frames of reference, written into the files.
BODY_FRAME = "body (metres); the file next to this one contains the body's pose in the world if it is known"
HEAD_FRAME = "head of the mast (metres: x forward, y left, z up at azimuth and elevation zero)"
#: Value of the line Model, by the name of the class; and of a CAHVORE camera, by its linearity.
_MODELS = {"CAHV": "CAHV = perspective, linear", "CAHVOR": "CAHVOR = perspective, distortion"}
_CAHVORE_MODELS = {1.0: "CAHVORE1 = perspective, distortion, pupil", 0.0: "CAHVORE2 = fish-eye"}
_ASSIGNMENT = re.compile(r"\s*(?P<name>[A-Za-z][A-Za-z_ ]*?)\s*=\s*(?P<value>.*?)\s*$")
_MODEL = re.compile(r"(?P<name>CAHV|CAHVOR|CAHVORE(?P<type>\d+)?)(?:\s*,\s*(?P<parameter>[^\s=]+))?\s*(?:=.*)?$")


def read_cahvor(path: str | Path, *, size: tuple[int, int] | None = None) -> CameraModel:
    """Read the camera model of a JPL text file.

    `size` is (columns, rows) of the image, required if the file has no line Dimensions; if it has one, both must agree.
    Raises CameraFileError if the file cannot be read, or if a line is missing, repeated or wrong. The message contains
    file, field and allowed values.
    """
    source = Source(str(path))
    lines: dict[str, tuple[str, int]] = {}
    for line_number, line in enumerate(source.read_text().splitlines(), start=1):
        match = _ASSIGNMENT.match(line.partition("#")[0])
        if match is not None and match["name"] in lines:
            name = match["name"]
            raise source.error(name, f"defined twice, in lines {lines[name][1]} and {line_number}", "once")
        if match is not None:
            lines[match["name"]] = match["value"], line_number

    if not any(name in lines for name in _LINES):
        raise source.error("file", "is in an unknown format", FORMATS)

    def find_line(name: str) -> tuple[str, int]:
        if name not in lines:
            raise source.error(name, "missing", f"a line '{name} = ...'")
        return lines[name]

    value, line_number = find_line("Model")
    model = _MODEL.match(value)
    if model is None:
        allowed = "CAHV, CAHVOR, CAHVORE1, CAHVORE2 or CAHVORE3,<linearity>"
        raise source.error("Model", f"{value!r} in line {line_number}", allowed)
    name = "CAHVORE" if model["name"].startswith("CAHVORE") else model["name"]
    cahvore_type = None if model["type"] is None else int(model["type"])
    linearity = None
    if name == "CAHVORE":
        linearity_text = model["parameter"]
        parameter = None if linearity_text is None else _parse_number("Model", linearity_text, line_number, source)
        linearity = linearity_of_type(cahvore_type, parameter, "Model", source)
    size = _read_size(lines.get("Dimensions"), size, source)
    vectors = {}
    for letter in name:
        value, line_number = find_line(letter)
        words = value.split()
        if len(words) != 3:
            raise source.error(letter, f"{len(words)} words in line {line_number}", "three finite numbers")
        vectors[letter] = [_parse_number(letter, word, line_number, source) for word in words]
    return create_camera(name, vectors, size, linearity, source)


def _parse_number(name: str, word: str, line_number: int, source: Source) -> float:
    try:
        return float(word)
    except ValueError:
        raise source.error(name, f"{word!r} in line {line_number} is not a number", "finite numbers") from None


def _read_size(line: tuple[str, int] | None, expected_size: tuple[int, int] | None, source: Source) -> tuple[int, int]:
    """Read (columns, rows) from the line Dimensions; if there is none, return `expected_size`."""
    if line is None:
        if expected_size is None:
            raise source.error("Dimensions", "missing", "a line 'Dimensions = columns rows', or size = [columns, rows]")
        return expected_size
    words = line[0].split()
    if len(words) != 2 or not all(word.isdecimal() and int(word) > 0 for word in words):
        fault = f"{line[0]!r} in line {line[1]}"
        raise source.error("Dimensions", fault, "two positive integers, columns and rows")
    file_size = int(words[0]), int(words[1])
    if expected_size is not None and expected_size != file_size:
        raise source.error(
            "Dimensions", f"{file_size[0]} {file_size[1]}", f"the given size, {expected_size[0]} {expected_size[1]}"
        )
    return file_size


def write_cahvor(camera: CameraModel, path: str | Path, comment: str = "", *, frame: str = "") -> None:
    """Write a JPL text file, from which `read_cahvor` reads an equal camera.

    `comment` and `frame` (a description of the frame of reference) are written as lines that begin with '#'.
    """
    if isinstance(camera, Cahvore):
        model = _CAHVORE_MODELS.get(camera.linearity, f"CAHVORE3,{camera.linearity!r} = general")
    else:
        model = _MODELS[type(camera).__name__.upper()]
    (hs, vs), (hc, vc), theta = camera.focal_lengths, camera.image_centre, camera.theta
    remarks = [*comment.splitlines(), *(f"Frame: {frame}".splitlines() if frame else [])]
    lines = [f"# {line}".rstrip() for line in remarks]
    lines += [f"Model = {model}", "", f"Dimensions = {camera.size[0]} {camera.size[1]}", ""]
    for letter in type(camera).__name__.upper():
        lines.append(f"{letter} = " + " ".join(repr(float(number)) for number in getattr(camera, letter.lower())))
    lines += ["", f"Hs    = {hs!r}", f"Hc    = {hc!r}", f"Vs    = {vs!r}", f"Vc    = {vc!r}"]
    lines += [f"Theta = {theta!r} ({math.degrees(theta):.6f} deg)"]
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")
