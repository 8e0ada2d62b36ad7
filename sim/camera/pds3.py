"""PDS3 labels and products: camera models, the picture and the rover's pose.

Each group GEOMETRIC_CAMERA_MODEL (Curiosity: GEOMETRIC_CAMERA_MODEL_PARMS) gives MODEL_TYPE, the letters of its
components (MODEL_COMPONENT_ID) and the components, in the frame named by REFERENCE_COORD_SYSTEM_NAME (a rover's frame,
metres: x forward, y right, z down). The vectors are returned in that frame. The picture's size is that of the label's
IMAGE object. Labels are attached to the product or detached; Curiosity's begin with ODL_VERSION_ID.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera.assembly import MAX_BYTES, MODELS, Source, create_camera, linearity_of_type
from marsyard.sim.camera.base import CameraModel
from marsyard.sim.files import check_regular
from marsyard.sim.frames import rigid

_GROUP = "GEOMETRIC_CAMERA_MODEL"
_GROUPS = (_GROUP, f"{_GROUP}_PARMS")
_FIRST_BYTES = 1 << 16
_START = re.compile(rb"^\s*(?:PDS|ODL)_VERSION_ID\s*=", re.MULTILINE)
_START_WITHIN = 4096
_END = re.compile(rb"^END\s*$", re.MULTILINE)
_METRES = ("METER", "METERS", "METRE", "METRES", "M", "N/A")
#: Groups of the rover's pose; the second is Curiosity's.
_ROVERS = ("ROVER_COORDINATE_SYSTEM", "ROVER_COORDINATE_SYSTEM_PARMS")
#: `9`, `20481 <BYTES>`, `("PICTURE.IMG", 9)`, `("PICTURE.IMG", 20481 <BYTES>)`, `"PICTURE.IMG"`.
_POINTER = re.compile(
    r"^[ \t]*\^IMAGE[ \t]*=[ \t]*"
    r"(?:\([ \t]*\"(?P<detached>[^\"\n]+)\"[ \t]*,[ \t]*(?P<at>\d+)[ \t]*(?P<at_bytes><BYTES>)?[ \t]*\)"
    r"|\"(?P<alone>[^\"\n]+)\"|(?P<number>\d+)[ \t]*(?P<bytes><BYTES>)?)[ \t]*\r?$",
    re.MULTILINE,
)
_RECORD = re.compile(r"^[ \t]*RECORD_BYTES[ \t]*=[ \t]*(\d+)", re.MULTILINE)
_CLOCK = re.compile(r"^[ \t]*SPACECRAFT_CLOCK_(START|STOP)_COUNT[ \t]*=[ \t]*\"?(\d+\.?\d*)\"?[ \t]*\r?$", re.MULTILINE)
#: Byte orders of integer samples by the first word of SAMPLE_TYPE; 8-bit samples have none.
_ORDERS = {"MSB": ">", "LSB": "<", "PC": "<", "SUN": ">", "UNSIGNED": ">", "INTEGER": ">"}
#: Tolerance on the length of a quaternion.
_UNIT = 1e-3


@dataclass(frozen=True)
class Pds3Product:
    """A picture with its pose and time by its label.

    - counts: as stored
    - site_from_rover: the rover's pose in the site frame (x north, y east, z down), metres; None if not in the label
    - time_s: spacecraft clock at the middle of the exposure; None if not in the label
    """

    counts: UInt16[np.ndarray, "rows columns"]
    site_from_rover: RigidTransform | None
    time_s: float | None


def read_pds3(path: str | Path, *, subframe_folded_in: bool = False) -> tuple[CameraModel, ...]:
    """Read every camera model of a PDS3 product (.IMG) or detached label (.LBL), in order; the image is not read.

    The standard does not define whether the model of a subframe, or of a picture with averaged pixels, describes the
    stored picture or the whole detector. Such labels are refused unless `subframe_folded_in` is set: the vectors then
    describe the stored picture. Raises CameraFileError if the label cannot be read, has no camera model, or one is
    incomplete or wrong; it names file, field and allowed values.
    """
    source = Source(str(path))
    label = _parse_blocks(_label_text(source), (*_GROUPS, "IMAGE", "INSTRUMENT_STATE_PARMS"), source)
    groups = [group for name, group in label.items() if name in _GROUPS]
    if not groups:
        raise source.error(_GROUP, "missing or not closed", "a label with at least one such group")
    size = _picture_size(label, source)
    if not subframe_folded_in:
        _refuse_subframes(label, source)
    return tuple(_camera(group, size, source) for group in groups)


def read_pds3_product(path: str | Path) -> Pds3Product:
    """Read a picture of 8 or 16-bit integers and its pose; `read_pds3` reads its camera.

    Raises CameraFileError if the label or the picture's file cannot be read, the picture has another type or is cut
    short, or the rover's pose is invalid; it names file, field and allowed values.
    """
    source = Source(str(path))
    text = _label_text(source)
    label = _parse_blocks(text, ("IMAGE", *_ROVERS), source)
    size = _picture_size(label, source)
    counts = _counts(label["IMAGE"], size, _locate_picture(text, source), source)
    times = [float(match[2]) for match in _CLOCK.finditer(text)]
    rover = next((name for name in _ROVERS if name in label), None)
    return Pds3Product(
        counts=counts,
        site_from_rover=None if rover is None else _pose(label[rover], rover, source),
        time_s=float(np.mean(times)) if times else None,
    )


def is_pds3(head: bytes) -> bool:
    """Whether the first bytes of a file are those of a PDS3 label or product."""
    return _START.search(head[:_START_WITHIN]) is not None


def _label_text(source: Source) -> str:
    """Read the text of a PDS3 label up to its END."""
    head = source.head(_FIRST_BYTES)
    if not is_pds3(head):
        raise source.error("PDS_VERSION_ID", "missing at the head of the file", "a PDS3 label or product")
    end = _END.search(head)
    if end is None:
        head = source.head(MAX_BYTES)
        end = _END.search(head)
    if end is None:
        raise source.error("END", f"missing in the first {MAX_BYTES} bytes", "a label closed by a line END")
    return head[: end.end()].decode("latin-1")


def _parse_blocks(text: str, names: Sequence[str], source: Source) -> Any:
    """Parse the groups and objects of these names in a label.

    pvl's strict parser refuses other parts of real labels (unquoted values that begin with a digit), and its lenient
    parser never returns from some damaged labels; the blocks are regular.
    """
    blocks = re.compile(
        rf"^[ \t]*(GROUP|OBJECT)[ \t]*=[ \t]*({'|'.join(names)})[ \t]*\r?$.*?^[ \t]*END_\1\b[^\n]*$",
        re.MULTILINE | re.DOTALL,
    )
    try:
        with warnings.catch_warnings():
            # pvl warns of a missing optional package and of a deprecated class of its own
            warnings.simplefilter("ignore", ImportWarning)
            warnings.simplefilter("ignore", PendingDeprecationWarning)
            from pvl.decoder import PDSLabelDecoder
            from pvl.grammar import PDSGrammar
            from pvl.parser import ODLParser

            grammar = PDSGrammar()
            parser = ODLParser(grammar=grammar, decoder=PDSLabelDecoder(grammar=grammar))
            return parser.parse("\n".join(block[0] for block in blocks.finditer(text)) + "\nEND\n")
    except Exception as fault:  # pvl raises many types, its own and Python's
        raise source.error("label", f"cannot be parsed ({fault})", "a PDS3 label") from fault


def _picture_size(label: Any, source: Source) -> tuple[int, int]:
    """(columns, rows) of the label's IMAGE object."""
    if "IMAGE" not in label or not isinstance(label["IMAGE"], Mapping):
        raise source.error("IMAGE", "missing", "an object with LINES and LINE_SAMPLES")
    image = label["IMAGE"]
    extents = []
    for field in ("LINE_SAMPLES", "LINES"):
        value = image.get(field)
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise source.error(f"IMAGE.{field}", _fault(value), "a positive integer")
        extents.append(value)
    return extents[0], extents[1]


def _refuse_subframes(label: Any, source: Source) -> None:
    state = label.get("INSTRUMENT_STATE_PARMS")
    fields = {f"IMAGE.{field}": label["IMAGE"].get(field) for field in ("FIRST_LINE", "FIRST_LINE_SAMPLE")}
    if isinstance(state, Mapping):
        for field in ("PIXEL_AVERAGING_HEIGHT", "PIXEL_AVERAGING_WIDTH"):
            fields[f"INSTRUMENT_STATE_PARMS.{field}"] = state.get(field)
    for field, stated in fields.items():
        value = getattr(stated, "value", stated)  # a quantity with its unit, as 2 <pixel>
        if isinstance(value, int) and value != 1:
            fault = f"{value}: of a part of the detector or of averaged pixels"
            raise source.error(field, fault, "1, or subframe_folded_in=True")


def _camera(group: Any, size: tuple[int, int], source: Source) -> CameraModel:
    if not isinstance(group, Mapping):
        raise source.error(_GROUP, "is not a group", "GROUP = GEOMETRIC_CAMERA_MODEL ... END_GROUP")
    name = group.get("MODEL_TYPE")
    if not isinstance(name, str) or name not in MODELS:
        raise source.error(f"{_GROUP}.MODEL_TYPE", _fault(name), ", ".join(MODELS))
    components = _components(group, source)
    vectors = {letter: _vector(letter, components, source) for letter in name}
    linearity = None
    if name == "CAHVORE":
        kind, parameter = (_number(letter, components, source) for letter in ("T", "P"))
        linearity = linearity_of_type(kind, parameter, f"{_GROUP}.MODEL_COMPONENT_ID T, P", source)
    return create_camera(name, vectors, size, linearity, source)


def _components(group: Any, source: Source) -> dict[str, tuple[str, Any]]:
    """Keyword and value of each component, by its letter."""
    letters = group.get("MODEL_COMPONENT_ID")
    if not isinstance(letters, list) or not all(isinstance(letter, str) for letter in letters):
        raise source.error(f"{_GROUP}.MODEL_COMPONENT_ID", _fault(letters), "a list of letters such as (C,A,H,V,O,R)")
    if len(set(letters)) != len(letters):
        raise source.error(f"{_GROUP}.MODEL_COMPONENT_ID", f"{letters} repeats a letter", "each letter once")
    units = group.get("MODEL_COMPONENT_UNIT", ["N/A"] * len(letters))
    for letter, unit in zip(letters, units, strict=False):
        if letter in ("C", "E") and str(unit).upper() not in _METRES:
            raise source.error(f"{_GROUP}.MODEL_COMPONENT_UNIT", f"{unit!r} for {letter}", "METER")
    keywords = {letter: f"MODEL_COMPONENT_{number}" for number, letter in enumerate(letters, start=1)}
    return {letter: (f"{_GROUP}.{keyword}", group.get(keyword)) for letter, keyword in keywords.items()}


def _vector(letter: str, components: Mapping[str, tuple[str, Any]], source: Source) -> list[float]:
    if letter not in components:
        raise source.error(f"{_GROUP}.MODEL_COMPONENT_ID", f"has no {letter}", "every letter of the model")
    field, value = components[letter]
    if not isinstance(value, list) or len(value) != 3 or not all(_is_number(number) for number in value):
        raise source.error(f"{field} ({letter})", _fault(value), "three finite numbers")
    return [float(number) for number in value]


def _number(letter: str, components: Mapping[str, tuple[str, Any]], source: Source) -> float | None:
    if letter not in components:
        return None
    field, value = components[letter]
    if not _is_number(value):
        raise source.error(f"{field} ({letter})", _fault(value), "a finite number")
    return float(value)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _fault(value: Any) -> str:
    return "missing" if value is None else f"{value!r}"


def _locate_picture(text: str, source: Source) -> tuple[Path, int]:
    """Return the file that holds the picture (the label's or one next to it), and the picture's offset in bytes."""
    pointer = _POINTER.search(text)
    if pointer is None:
        raise source.error("^IMAGE", "missing, or of another form", 'a record, bytes, or ("FILE", record)')
    name = pointer["detached"] or pointer["alone"]
    path = Path(source.path)
    if name is not None:
        if Path(name).name != name:
            raise source.error("^IMAGE", f"names {name!r}, a file elsewhere", "a file next to the label")
        # archives differ in the case of names
        paths = [path.parent / name, path.parent / name.lower(), path.parent / name.upper()]
        path = next((one for one in paths if one.exists()), paths[0])
    number = int(pointer["at"] or pointer["number"] or 1)
    if number == 1 or pointer["at_bytes"] or pointer["bytes"]:
        return path, number - 1
    record = _RECORD.search(text)
    if record is None:
        raise source.error("RECORD_BYTES", "missing", "the bytes of a record")
    return path, (number - 1) * int(record[1])


def _counts(
    image: Any, size: tuple[int, int], location: tuple[Path, int], source: Source
) -> UInt16[np.ndarray, "rows columns"]:
    bits, kind = image.get("SAMPLE_BITS"), str(image.get("SAMPLE_TYPE", ""))
    order = _ORDERS.get(kind.split("_")[0])
    if bits not in (8, 16) or order is None or not kind.endswith("INTEGER"):
        raise source.error("IMAGE.SAMPLE_TYPE, SAMPLE_BITS", f"{kind}, {bits}", "integers of 8 or 16 bits")
    for field, allowed in (("BANDS", 1), ("LINE_PREFIX_BYTES", 0), ("LINE_SUFFIX_BYTES", 0)):
        if image.get(field, allowed) != allowed:
            raise source.error(f"IMAGE.{field}", f"{image.get(field)}", f"{allowed}")
    signed = bits == 16 and "UNSIGNED" not in kind
    sample = np.dtype(f"{order}{'i' if signed else 'u'}{bits // 8}")
    columns, rows = size
    path, offset = location
    wanted = columns * rows * sample.itemsize
    try:
        # at most the file's size: a label may state any size
        available = max(min(check_regular(path).st_size - offset, wanted), 0)
        with path.open("rb") as file:
            file.seek(offset)
            data = file.read(available)
    except OSError as fault:
        raise source.error("^IMAGE", f"{path} cannot be read ({fault.strerror})", "the picture's file") from fault
    if len(data) < wanted:
        raise source.error("IMAGE", f"ends after {len(data)} bytes", f"{columns} x {rows} samples of {bits} bits")
    counts = np.frombuffer(data, dtype=sample).reshape(rows, columns)
    if signed and counts.min() < 0:
        raise source.error("IMAGE", f"holds counts down to {counts.min()}", "counts from 0")
    return counts.astype(np.uint16)


def _pose(group: Any, name: str, source: Source) -> RigidTransform:
    """The rover's pose in the site frame, by the group's offset and quaternion (scalar first)."""
    vectors = {}
    for field, length in (("ORIGIN_OFFSET_VECTOR", 3), ("ORIGIN_ROTATION_QUATERNION", 4)):
        value = group.get(field) if isinstance(group, Mapping) else None
        numeric = isinstance(value, list) and all(isinstance(one, int | float) for one in value)
        if not numeric or len(value) != length:  # type: ignore[arg-type]  # a list, as just seen
            raise source.error(f"{name}.{field}", f"{value!r}", f"{length} numbers")
        vectors[field] = np.array(value, dtype=np.float64)
    scalar_first = vectors["ORIGIN_ROTATION_QUATERNION"]
    if abs(float(np.linalg.norm(scalar_first)) - 1.0) > _UNIT:
        raise source.error(f"{name}.ORIGIN_ROTATION_QUATERNION", "is not of length 1", "a unit quaternion")
    return rigid(Rotation.from_quat(scalar_first[[1, 2, 3, 0]]), vectors["ORIGIN_OFFSET_VECTOR"])
