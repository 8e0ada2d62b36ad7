"""JPL's text files of camera models (.cahv, .cahvor, .cahvore), as written by the programs CCALADJ and cmod.

    Model = CAHVOR = perspective, distortion
    Dimensions = 1024 1024
    C =  0.442604 -0.0611635 -1.25106
    A = ...

and the model's other vectors H, V, O, R, E. CAHVORE states its type (1 perspective, 2 fish-eye, 3 general) and for
type 3 the linearity: ``Model = CAHVORE3,0.37 = general``. The derived lines Hs, Hc, Vs, Vc and Theta, the covariance
matrices ``S`` and ``S internal`` and unknown lines are not read.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from marsyard.sim.camera.assembly import Source, create_camera, linearity_of_type
from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.models import Cahvore

#: Frames of written cameras, as stated in their files.
BODY_FRAME = "body (metres); the body's pose in the world, where it is known, is stated next to this file"
HEAD_FRAME = "head of the mast (metres: x forward, y left, z up at azimuth and elevation zero)"

_TYPE_NAMES = {
    "CAHV": "CAHV = perspective, linear",
    "CAHVOR": "CAHVOR = perspective, distortion",
    1.0: "CAHVORE1 = perspective, distortion, pupil",
    0.0: "CAHVORE2 = fish-eye",
}
_ASSIGNMENT = re.compile(r"\s*(?P<name>[A-Za-z][A-Za-z_ ]*?)\s*=\s*(?P<value>.*?)\s*$")
_MODEL = re.compile(r"(?P<name>CAHV|CAHVOR|CAHVORE(?P<type>\d+)?)(?:\s*,\s*(?P<parameter>[^\s=]+))?\s*(?:=.*)?$")


class _Line(NamedTuple):
    number: int
    value: str


def read_cahvor(path: str | Path, *, size: tuple[int, int] | None = None) -> CameraModel:
    """Read the camera model of a JPL text file.

    `size` is (columns, rows) of the pictures, for files without the line Dimensions; otherwise it must agree. Raises
    CameraFileError if the file cannot be read, or a line is missing, repeated or wrong; it names file, field and
    allowed values.
    """
    source = Source(str(path))
    lines = _assignments(source.text(), source)
    name, linearity = _model(_required(lines, "Model", source), source)
    size = _size(lines, size, source)
    vectors = {letter: _vector(letter, _required(lines, letter, source), source) for letter in name}
    return create_camera(name, vectors, size, linearity, source)


def write_cahvor(camera: CameraModel, path: str | Path, comment: str = "", *, frame: str = "") -> None:
    """Write a JPL text file, equal when read back; `comment` and `frame` become lines with '#' at the start."""
    if isinstance(camera, Cahvore):
        model = _TYPE_NAMES.get(camera.linearity, f"CAHVORE3,{camera.linearity!r} = general")
    else:
        model = _TYPE_NAMES[type(camera).__name__.upper()]
    (hs, vs), (hc, vc), theta = camera.focal_lengths, camera.image_centre, camera.theta
    lines = [f"# {line}".rstrip() for line in (*comment.splitlines(), *([f"Frame: {frame}"] if frame else []))]
    lines += [f"Model = {model}", "", f"Dimensions = {camera.size[0]} {camera.size[1]}", ""]
    for letter in type(camera).__name__.upper():
        lines.append(f"{letter} = " + " ".join(repr(float(number)) for number in getattr(camera, letter.lower())))
    lines += ["", f"Hs    = {hs!r}", f"Hc    = {hc!r}", f"Vs    = {vs!r}", f"Vc    = {vc!r}"]
    lines += [f"Theta = {theta!r} ({theta * 57.29577951308232:.6f} deg)"]
    Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _assignments(text: str, source: Source) -> dict[str, _Line]:
    lines: dict[str, _Line] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        match = _ASSIGNMENT.match(line.partition("#")[0])
        if match is None:
            continue
        name = match["name"]
        if name in lines:
            raise source.error(name, f"given twice, in lines {lines[name].number} and {number}", "once")
        lines[name] = _Line(number, match["value"])
    return lines


def _required(lines: dict[str, _Line], name: str, source: Source) -> _Line:
    if name not in lines:
        raise source.error(name, "missing", f"a line '{name} = ...'")
    return lines[name]


def _model(line: _Line, source: Source) -> tuple[str, float | None]:
    match = _MODEL.match(line.value)
    allowed = "CAHV, CAHVOR, CAHVORE1, CAHVORE2 or CAHVORE3,<linearity>"
    if match is None:
        raise source.error("Model", f"{line.value!r} in line {line.number}", allowed)
    if not match["name"].startswith("CAHVORE"):
        return match["name"], None
    parameter = None if match["parameter"] is None else _number("Model", match["parameter"], line, source)
    kind = None if match["type"] is None else int(match["type"])
    return "CAHVORE", linearity_of_type(kind, parameter, "Model", source)


def _size(lines: dict[str, _Line], given: tuple[int, int] | None, source: Source) -> tuple[int, int]:
    """(columns, rows) by the file, or as given if the file does not state them."""
    if "Dimensions" not in lines:
        if given is None:
            raise source.error("Dimensions", "missing", "a line 'Dimensions = columns rows', or size = [columns, rows]")
        return given
    line = lines["Dimensions"]
    words = line.value.split()
    if len(words) != 2 or not all(word.isdecimal() and int(word) > 0 for word in words):
        fault = f"{line.value!r} in line {line.number}"
        raise source.error("Dimensions", fault, "two positive integers, columns and rows")
    stated = int(words[0]), int(words[1])
    if given is not None and given != stated:
        raise source.error("Dimensions", f"{stated[0]} {stated[1]}", f"the given size, {given[0]} {given[1]}")
    return stated


def _vector(name: str, line: _Line, source: Source) -> list[float]:
    words = line.value.split()
    if len(words) != 3:
        raise source.error(name, f"{len(words)} words in line {line.number}", "three finite numbers")
    return [_number(name, word, line, source) for word in words]


def _number(name: str, word: str, line: _Line, source: Source) -> float:
    try:
        return float(word)
    except ValueError:
        raise source.error(name, f"{word!r} in line {line.number} is not a number", "finite numbers") from None
