"""PDS3 labels and products: camera models, the image, the rover's pose and the time of the exposure.

Labels are attached to the product or detached; Curiosity's begin with ODL_VERSION_ID. Each group GEOMETRIC_CAMERA_MODEL
(Curiosity: GEOMETRIC_CAMERA_MODEL_PARMS) contains MODEL_TYPE, the letters of the components (MODEL_COMPONENT_ID) and
the components, in the frame named by REFERENCE_COORD_SYSTEM_NAME (by default the rover's frame, metres: x forward,
y right, z down). Groups such as ROVER_COORDINATE_SYSTEM define the transforms between frames
(`marsyard.sim.camera.label_frames`).
"""

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt16
from scipy.spatial.transform import RigidTransform

from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.file_reading import MAX_BYTES, MODELS, SUBFRAME, Source, create_camera, linearity_of_type
from marsyard.sim.camera.label_frames import (
    ROVER_FRAME,
    SITE,
    CoordinateSystem,
    FramedCamera,
    LabelFrame,
    find_pose,
    resolve_camera,
    transform_from_label,
)
from marsyard.sim.files import check_regular

#: Group of a camera model, and its two names.
_CAMERA_GROUP = "GEOMETRIC_CAMERA_MODEL"
_CAMERA_GROUPS = (_CAMERA_GROUP, f"{_CAMERA_GROUP}_PARMS")
#: Units of C and E that are metres; without a unit, metres are assumed.
_PDS3_METRES = ("METER", "METERS", "METRE", "METRES", "M", "N/A")
#: Number of bytes in which the end of a label is searched first; then `MAX_BYTES`.
_FIRST_BYTES = 1 << 16
#: First line of a PDS3 label.
_START = re.compile(rb"^\s*(?:PDS|ODL)_VERSION_ID\s*=", re.MULTILINE)
#: Number of bytes in which the start of a label is searched.
_START_BYTES = 4096
#: The label's last line: END alone, before a character that no label contains, or before padding; and END as the last
#: bytes before the image.
_END = re.compile(rb"^[ \t]*END(?=[ \t]*(?:[\r\n]|[^\x20-\x7e\t])| {8})", re.MULTILINE)
_END_OF_HEAD = re.compile(rb"^[ \t]*END\s*\Z", re.MULTILINE)
#: Groups that define frames, and the frames to which their definitions refer by default; Curiosity's end in _PARMS.
_FRAME_GROUPS = {
    f"{name}_COORDINATE_SYSTEM{end}": (name, reference)
    for name, reference in (("ROVER", SITE), ("LANDER", SITE), ("SITE", SITE), ("LOCAL_LEVEL", SITE))
    for end in ("", "_PARMS")
}
#: Values of numbers that are not known.
_UNKNOWN = ("UNK", "N/A", "NULL")
#: The pointer ^IMAGE, on one line or several, with one of `9`, `20481 <BYTES>`, `"A.IMG"`, `("A.IMG")`, `("A.IMG", 9)`,
#: `("A.IMG", 20481 <BYTES>)`: the image's file, and its first record or byte (counted from 1).
_POINTER = re.compile(
    r"^[ \t]*\^IMAGE\s*=\s*(?P<list>\()?\s*(?:[\"'](?P<file>[^\"'\n]+)[\"']\s*)?(?(file)(?:,\s*)?)"
    r"(?:(?P<position>\d+)\s*(?P<in_bytes><\s*BYTES?\s*>)?\s*)?(?(list)\))[ \t]*(?:/\*|\r?$)",
    re.MULTILINE | re.IGNORECASE,
)
_RECORD = re.compile(r"^[ \t]*RECORD_BYTES[ \t]*=[ \t]*(\d+)", re.MULTILINE)
_CLOCK = re.compile(r"^[ \t]*SPACECRAFT_CLOCK_(START|STOP)_COUNT[ \t]*=[ \t]*\"?(\d+\.?\d*)\"?[ \t]*\r?$", re.MULTILINE)
#: Byte orders of integer samples by the first word of SAMPLE_TYPE; for 8-bit samples the order has no effect.
_BYTE_ORDERS = {"MSB": ">", "LSB": "<", "PC": "<", "SUN": ">", "UNSIGNED": ">", "INTEGER": ">"}


def read_pds3(path: str | Path, *, subframe_folded_in: bool = False) -> tuple[FramedCamera, ...]:
    """Read every camera model of a PDS3 product (.IMG) or detached label (.LBL), in order; the image is not read.

    Models are returned in the vehicle's frame if the label contains the transform to it, else in the site's or the
    Mars-fixed frame. The standard does not define whether the model of a subframe, or of an image with averaged pixels,
    describes the stored image or the whole detector. Such labels are refused by default. With `subframe_folded_in` they
    are accepted, and the vectors are assumed to describe the stored image.

    Raises CameraFileError if the label cannot be read or has no camera model, if a model is incomplete or wrong, or if
    the label contains none of these transforms. The message contains file, field and allowed values.
    """
    source = Source(str(path))
    label = _parse_blocks(
        _read_label(source), (*_CAMERA_GROUPS, *_FRAME_GROUPS, "IMAGE", "INSTRUMENT_STATE_PARMS"), source
    )
    groups = [group for name, group in label.items() if name in _CAMERA_GROUPS]
    if not groups:
        raise source.error(_CAMERA_GROUP, "missing or not closed", "a label with at least one such group")
    size = _read_size(label, source)
    fields = {f"IMAGE.{field}": label["IMAGE"].get(field) for field in ("FIRST_LINE", "FIRST_LINE_SAMPLE")}
    state = label.get("INSTRUMENT_STATE_PARMS")
    if isinstance(state, Mapping):
        for field in ("PIXEL_AVERAGING_HEIGHT", "PIXEL_AVERAGING_WIDTH"):
            fields[f"INSTRUMENT_STATE_PARMS.{field}"] = state.get(field)
    for field, quantity in fields.items():
        value = getattr(quantity, "value", quantity)  # pvl parses 2 <pixel> to an object with value and unit
        if not subframe_folded_in and isinstance(value, int) and value != 1:
            raise source.error(field, f"{value}: {SUBFRAME}", "1, or subframe_folded_in=True")
    systems = _read_systems(label, source)
    field = f"{_CAMERA_GROUP}.REFERENCE_COORD_SYSTEM_NAME"
    return tuple(
        resolve_camera(_create_camera(group, size, source), _read_frame(group, "REFERENCE"), systems, field, source)
        for group in groups
    )


def _create_camera(group: Any, size: tuple[int, int], source: Source) -> CameraModel:
    """Create the camera of a group; the letters in MODEL_COMPONENT_ID assign its components to vectors."""

    def is_number(value: Any) -> bool:
        return isinstance(value, int | float) and not isinstance(value, bool)

    if not isinstance(group, Mapping):
        raise source.error(_CAMERA_GROUP, "is not a group", "GROUP = GEOMETRIC_CAMERA_MODEL ... END_GROUP")
    name, letters = group.get("MODEL_TYPE"), group.get("MODEL_COMPONENT_ID")
    id_field = f"{_CAMERA_GROUP}.MODEL_COMPONENT_ID"
    if not isinstance(name, str) or name not in MODELS:
        raise source.error(f"{_CAMERA_GROUP}.MODEL_TYPE", _describe_fault(name), ", ".join(MODELS))
    if not isinstance(letters, list) or not all(isinstance(letter, str) for letter in letters):
        raise source.error(id_field, _describe_fault(letters), "a list of letters such as (C,A,H,V,O,R)")
    if len(set(letters)) != len(letters):
        raise source.error(id_field, f"{letters} repeats a letter", "each letter once")
    units = group.get("MODEL_COMPONENT_UNIT", "N/A")
    for letter, unit in zip(letters, units if isinstance(units, list) else [units] * len(letters), strict=False):
        if letter in ("C", "E") and str(unit).upper() not in _PDS3_METRES:
            raise source.error(f"{_CAMERA_GROUP}.MODEL_COMPONENT_UNIT", f"{unit!r} for {letter}", "METER")
    vectors: dict[str, list[float]] = {}
    for letter in name:
        if letter not in letters:
            raise source.error(id_field, f"has no {letter}", "every letter of the model")
        keyword = f"MODEL_COMPONENT_{letters.index(letter) + 1}"
        value: Any = group.get(keyword)
        if not isinstance(value, list) or len(value) != 3 or not all(is_number(number) for number in value):
            raise source.error(f"{_CAMERA_GROUP}.{keyword} ({letter})", _describe_fault(value), "three finite numbers")
        vectors[letter] = [float(number) for number in value]
    if name != "CAHVORE":
        return create_camera(name, vectors, size, None, source)

    def read_lens(letter: str, default_number: int) -> float | None:
        """Read the type T or the parameter P; labels of Mars 2020's landing camera name no letters for them."""
        number = letters.index(letter) + 1 if letter in letters else default_number
        value: Any = group.get(f"MODEL_COMPONENT_{number}")
        if value is None and letter not in letters:
            return None
        if not is_number(value):
            field = f"{_CAMERA_GROUP}.MODEL_COMPONENT_{number} ({letter})"
            raise source.error(field, _describe_fault(value), "a finite number")
        return float(value)

    lens_type = read_lens("T", 8)
    parameter = read_lens("P", 9) if lens_type == 3 else None
    return create_camera(
        name, vectors, size, linearity_of_type(lens_type, parameter, f"{id_field} T, P", source), source
    )


@dataclass(frozen=True)
class Pds3Product:
    """An image of a rover with the rover's pose and the time from the image's label.

    - counts: the stored numbers of the pixels, DN
    - pose: frame of reference (a site's or the Mars-fixed frame) and the rover's pose in it, metres; None if not in the
      label
    - time_s: spacecraft clock at the middle of the exposure, or at its start or end if the label has only one of them;
      None without both
    """

    counts: UInt16[np.ndarray, "rows columns"]
    pose: tuple[LabelFrame, RigidTransform] | None
    time_s: float | None


def read_pds3_product(path: str | Path) -> Pds3Product:
    """Read an image of 8-bit or 16-bit integers, the rover's pose and the time; `read_pds3` reads the camera.

    Raises CameraFileError if the label or the image's file cannot be read, the image has another type or is
    incomplete, or the rover's pose is invalid. The message contains file, field and allowed values.
    """
    source = Source(str(path))
    text = _read_label(source)
    label = _parse_blocks(text, ("IMAGE", *_FRAME_GROUPS), source)
    size = _read_size(label, source)
    counts = _read_counts(text, label["IMAGE"], size, source)
    # middle of the exposure: mean of the start and stop counts
    times = [float(match[2]) for match in _CLOCK.finditer(text)]
    time_s = float(np.mean(times)) if times else None
    systems = _read_systems(label, source)
    vehicle = next((system.frame for system in systems if system.frame.is_vehicle), None)
    pose = None if vehicle is None else find_pose(vehicle, systems)
    if vehicle is not None and pose is None:
        field = f"{vehicle.name}_COORDINATE_SYSTEM.REFERENCE_COORD_SYSTEM_NAME"
        raise source.error(field, "is a frame without known pose", "SITE_FRAME or MCMF_FRAME")
    return Pds3Product(counts, pose, time_s)


def _read_counts(text: str, image: Any, size: tuple[int, int], source: Source) -> UInt16[np.ndarray, "rows columns"]:
    """Read the image's samples at the label's pointer ^IMAGE. Raises CameraFileError."""
    pointer = _POINTER.search(text)
    if pointer is None or not (pointer["file"] or pointer["position"]):
        raise source.error("^IMAGE", "missing or not readable", 'a record, bytes, or ("FILE", record)')
    name = pointer["file"]
    path = Path(source.path)
    if name is not None:
        if Path(name).name != name:
            raise source.error("^IMAGE", f"{name!r} is in another folder", "a file next to the label")
        # some archives write the file name in lower or upper case
        paths = [path.parent / name, path.parent / name.lower(), path.parent / name.upper()]
        path = next((path for path in paths if path.exists()), paths[0])
    offset = _image_offset(pointer, text, source)
    bits, type_name = image.get("SAMPLE_BITS"), str(image.get("SAMPLE_TYPE", ""))
    order = _BYTE_ORDERS.get(type_name.split("_")[0])
    if bits not in (8, 16) or order is None or not type_name.endswith("INTEGER"):
        raise source.error("IMAGE.SAMPLE_TYPE, SAMPLE_BITS", f"{type_name}, {bits}", "integers of 8 or 16 bits")
    for field, allowed in (("BANDS", 1), ("LINE_PREFIX_BYTES", 0), ("LINE_SUFFIX_BYTES", 0)):
        if image.get(field, allowed) != allowed:
            raise source.error(f"IMAGE.{field}", f"{image.get(field)}", f"{allowed}")
    is_signed = bits == 16 and "UNSIGNED" not in type_name
    sample_type = np.dtype(f"{order}{'i' if is_signed else 'u'}{bits // 8}")
    columns, rows = size
    required_bytes = columns * rows * sample_type.itemsize
    try:
        # limited to the file's size, because a damaged label can contain any size
        available_bytes = max(min(check_regular(path).st_size - offset, required_bytes), 0)
        with path.open("rb") as file:
            file.seek(offset)
            data = file.read(available_bytes)
    except OSError as error:
        raise source.error("^IMAGE", f"{path} cannot be read ({error.strerror})", "the image's file") from error
    if len(data) < required_bytes:
        raise source.error("IMAGE", f"ends after {len(data)} bytes", f"{columns} x {rows} samples of {bits} bits")
    counts = np.frombuffer(data, dtype=sample_type).reshape(rows, columns)
    if is_signed and counts.min() < 0:
        raise source.error("IMAGE", f"contains counts down to {counts.min()}", "counts from 0")
    return counts.astype(np.uint16)


def _read_frame(group: Any, kind: str, default: str = ROVER_FRAME.name) -> LabelFrame:
    """Read the frame of a group: its own (kind COORDINATE) or the one that it refers to (kind REFERENCE)."""
    prefix = "COORDINATE_SYSTEM" if kind == "COORDINATE" else "REFERENCE_COORD_SYSTEM"
    name, indices = group.get(f"{prefix}_NAME"), group.get(f"{prefix}_INDEX", [])
    indices = indices if isinstance(indices, list) else [indices]
    is_known = all(isinstance(index, int) for index in indices)
    return LabelFrame.of(name if isinstance(name, str) else default, indices if is_known else ())


def _read_systems(label: Any, source: Source) -> list[CoordinateSystem]:
    """Read the definitions of frames, except those whose values are unknown. Raises CameraFileError."""
    systems = []
    for name, group in label.items():
        if name not in _FRAME_GROUPS or not isinstance(group, Mapping):
            continue
        vectors: list[list[float]] = []
        for field, length in (("ORIGIN_OFFSET_VECTOR", 3), ("ORIGIN_ROTATION_QUATERNION", 4)):
            value = group.get(field)
            items: list[Any] = value if isinstance(value, list) else [value]
            if any(isinstance(item, str) and item.upper() in _UNKNOWN for item in items):
                break
            if len(items) != length or not all(isinstance(item, int | float) for item in items):
                raise source.error(f"{name}.{field}", f"{value!r}", f"{length} numbers")
            vectors.append(items)
        else:
            offset, quaternion = vectors
            transform = transform_from_label(offset, quaternion, f"{name}.ORIGIN_ROTATION_QUATERNION", source)
            own, reference = _FRAME_GROUPS[name]
            frames = _read_frame(group, "COORDINATE", own), _read_frame(group, "REFERENCE", reference)
            systems.append(CoordinateSystem(*frames, transform))
    return systems


def is_pds3(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of a PDS3 label or product."""
    return _START.search(head[:_START_BYTES]) is not None


def _read_label(source: Source) -> str:
    """Read the label up to its END line. Raises CameraFileError."""
    for count in (_FIRST_BYTES, MAX_BYTES):
        head = source.read_head(count)
        if not is_pds3(head):
            raise source.error("PDS_VERSION_ID", "missing at the start of the file", "a PDS3 label or product")
        end = _END.search(head) or (_END_OF_HEAD.search(head) if len(head) < count else None)
        text = head[: len(head) if end is None else end.end()].decode("latin-1")
        if end is None:  # the image can follow END without a line break
            pointer = _POINTER.search(text)
            if pointer is None or pointer["file"] or not (pointer["in_bytes"] or _RECORD.search(text)):
                continue
            end = _END_OF_HEAD.search(head[: _image_offset(pointer, text, source)])
            text = text[: 0 if end is None else end.end()]
        if end is not None:
            return text
    raise source.error("END", f"missing in the first {MAX_BYTES} bytes", "a label that ends with a line END")


def _image_offset(pointer: re.Match[str], text: str, source: Source) -> int:
    """Return the number of bytes before the image. Raises CameraFileError if the length of a record is missing."""
    offset = int(pointer["position"] or 1) - 1
    if offset > 0 and not pointer["in_bytes"]:
        record = _RECORD.search(text)
        if record is None:
            raise source.error("RECORD_BYTES", "missing", "the number of bytes of a record")
        offset *= int(record[1])
    return offset


def _parse_blocks(text: str, names: Sequence[str], source: Source) -> Any:
    """Parse the groups and objects of these names in a label.

    Only these blocks are parsed, because pvl's strict parser fails on other parts of real labels (unquoted values that
    begin with a digit), and its lenient parser never returns for some damaged labels.
    """
    blocks = re.compile(
        rf"^[ \t]*(GROUP|OBJECT)[ \t]*=[ \t]*({'|'.join(names)})[ \t]*\r?$.*?^[ \t]*END_\1\b[^\n]*$",
        re.MULTILINE | re.DOTALL,
    )
    try:
        with warnings.catch_warnings():
            # pvl warns of a missing optional package and of its use of a deprecated class
            warnings.simplefilter("ignore", ImportWarning)
            warnings.simplefilter("ignore", PendingDeprecationWarning)
            from pvl.decoder import PDSLabelDecoder
            from pvl.grammar import PDSGrammar
            from pvl.parser import ODLParser

            grammar = PDSGrammar()
            parser = ODLParser(grammar=grammar, decoder=PDSLabelDecoder(grammar=grammar))
            return parser.parse("\n".join(block[0] for block in blocks.finditer(text)) + "\nEND\n")
    except Exception as error:  # pvl raises many types, its own and Python's
        raise source.error("label", f"cannot be parsed ({error})", "a PDS3 label") from error


def _read_size(label: Any, source: Source) -> tuple[int, int]:
    """Read (columns, rows) of the label's IMAGE object. Raises CameraFileError."""
    if "IMAGE" not in label or not isinstance(label["IMAGE"], Mapping):
        raise source.error("IMAGE", "missing", "an object with LINES and LINE_SAMPLES")
    image = label["IMAGE"]
    extents = []
    for field in ("LINE_SAMPLES", "LINES"):
        value = image.get(field)
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise source.error(f"IMAGE.{field}", _describe_fault(value), "a positive integer")
        extents.append(value)
    return extents[0], extents[1]


def _describe_fault(value: Any) -> str:
    """Describe the value of a keyword in an error message; None is a missing keyword."""
    return "missing" if value is None else f"{value!r}"
