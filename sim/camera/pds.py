"""Readers of PDS3 and PDS4 labels: camera models; for PDS3 products also the image and the rover's pose.

PDS3: each group GEOMETRIC_CAMERA_MODEL (Curiosity: GEOMETRIC_CAMERA_MODEL_PARMS) contains MODEL_TYPE, the letters of
the components (MODEL_COMPONENT_ID) and the components, in the frame named by REFERENCE_COORD_SYSTEM_NAME (a rover's
frame, metres: x forward, y right, z down). The vectors are returned in that frame. The image's size is that of the
label's IMAGE object. Labels are attached to the product or detached; Curiosity's begin with ODL_VERSION_ID.

PDS4: the class `geom:Camera_Model_Parameters` of the geometry dictionary. Vectors are returned in the frame named by
the label (`Coordinate_Space_Reference`). The image's size is that of the label's image array. Prefixes and versions
of namespaces are ignored.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.calibrations import MAX_BYTES, MODELS, Source, create_camera, linearity_of_type
from marsyard.sim.files import check_regular
from marsyard.sim.frames import rigid

#: PDS3: group of a camera model, and its two names.
_CAMERA_GROUP = "GEOMETRIC_CAMERA_MODEL"
_CAMERA_GROUPS = (_CAMERA_GROUP, f"{_CAMERA_GROUP}_PARMS")
#: Number of bytes in which the end of a label is searched first; then `MAX_BYTES`.
_FIRST_BYTES = 1 << 16
#: First line of a PDS3 label.
_START = re.compile(rb"^\s*(?:PDS|ODL)_VERSION_ID\s*=", re.MULTILINE)
#: Number of bytes in which the start of a label is searched.
_START_BYTES = 4096
_END = re.compile(rb"^END\s*$", re.MULTILINE)
#: Units of C and E that are metres; without a unit, metres are assumed.
_PDS3_METRES = ("METER", "METERS", "METRE", "METRES", "M", "N/A")
#: Names of the group with the rover's pose; the second is Curiosity's.
_POSE_GROUPS = ("ROVER_COORDINATE_SYSTEM", "ROVER_COORDINATE_SYSTEM_PARMS")
#: The ^IMAGE line with one of `9`, `20481 <BYTES>`, `("A.IMG", 9)`, `("A.IMG", 20481 <BYTES>)`, `"A.IMG"`: the image's
#: first record or byte (counted from 1), and its file. Groups: `file...` with both, `file_only`, `position`.
_POINTER = re.compile(
    r"^[ \t]*\^IMAGE[ \t]*=[ \t]*"
    r"(?:\([ \t]*\"(?P<file>[^\"\n]+)\"[ \t]*,[ \t]*(?P<file_position>\d+)[ \t]*(?P<file_in_bytes><BYTES>)?[ \t]*\)"
    r"|\"(?P<file_only>[^\"\n]+)\"|(?P<position>\d+)[ \t]*(?P<in_bytes><BYTES>)?)[ \t]*\r?$",
    re.MULTILINE,
)
_RECORD = re.compile(r"^[ \t]*RECORD_BYTES[ \t]*=[ \t]*(\d+)", re.MULTILINE)
_CLOCK = re.compile(r"^[ \t]*SPACECRAFT_CLOCK_(START|STOP)_COUNT[ \t]*=[ \t]*\"?(\d+\.?\d*)\"?[ \t]*\r?$", re.MULTILINE)
#: Byte orders of integer samples by the first word of SAMPLE_TYPE; for 8-bit samples the order has no effect.
_BYTE_ORDERS = {"MSB": ">", "LSB": "<", "PC": "<", "SUN": ">", "UNSIGNED": ">", "INTEGER": ">"}
#: Tolerance on the length of a quaternion.
_QUATERNION_TOLERANCE = 1e-3
#: End of the message for images that are refused by default.
_SUBFRAME = "of a part of the detector or of averaged pixels"

#: PDS4: start of an XML file, and names in the geometry dictionary.
_XML_START = re.compile(rb"\A(\xef\xbb\xbf)?\s*<(\?xml|[A-Za-z_][\w:.-]*[\s>])")
_PARAMETERS = "Camera_Model_Parameters"
_POSITION, _DIRECTION, _PIXEL = (tuple(f"{axis}_{kind}" for axis in "xyz") for kind in ("position", "unit", "pixel"))
_TERMS = ("c0", "c1", "c2")
#: Element and components of each vector of a model.
_VECTORS = {
    "C": ("Vector_Center", _POSITION),
    "A": ("Vector_Axis", _DIRECTION),
    "H": ("Vector_Horizontal", _PIXEL),
    "V": ("Vector_Vertical", _PIXEL),
    "O": ("Vector_Optical", _DIRECTION),
    "R": ("Radial_Terms", _TERMS),
    "E": ("Entrance_Terms", _TERMS),
}
_PDS4_METRES = (None, "m", "meter", "metre")


@dataclass(frozen=True)
class Pds3Product:
    """An image of a rover with the rover's pose and the time from the image's label.

    - counts: the stored numbers of the pixels, DN
    - site_from_rover: the rover's pose in the site frame (x north, y east, z down), metres; None if not in the label
    - time_s: spacecraft clock at the middle of the exposure; None if not in the label
    """

    counts: UInt16[np.ndarray, "rows columns"]
    site_from_rover: RigidTransform | None
    time_s: float | None


def read_pds3(path: str | Path, *, subframe_folded_in: bool = False) -> tuple[CameraModel, ...]:
    """Read every camera model of a PDS3 product (.IMG) or detached label (.LBL), in order; the image is not read.

    The standard does not define whether the model of a subframe, or of an image with averaged pixels, describes the
    stored image or the whole detector. Such labels are refused by default. With `subframe_folded_in` they are accepted,
    and the vectors are assumed to describe the stored image. Raises CameraFileError if the label cannot be read or has
    no camera model, or if a model is incomplete or wrong. The message contains file, field and allowed values.
    """
    source = Source(str(path))
    label = _parse_blocks(_read_label(source), (*_CAMERA_GROUPS, "IMAGE", "INSTRUMENT_STATE_PARMS"), source)
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
            raise source.error(field, f"{value}: {_SUBFRAME}", "1, or subframe_folded_in=True")
    return tuple(_create_pds3_camera(group, size, source) for group in groups)


def read_pds3_product(path: str | Path) -> Pds3Product:
    """Read an image of 8-bit or 16-bit integers, the rover's pose and the time; `read_pds3` reads the camera.

    Raises CameraFileError if the label or the image's file cannot be read, the image has another type or is
    incomplete, or the rover's pose is invalid. The message contains file, field and allowed values.
    """
    source = Source(str(path))
    text = _read_label(source)
    label = _parse_blocks(text, ("IMAGE", *_POSE_GROUPS), source)
    size = _read_size(label, source)
    counts = _read_counts(text, label["IMAGE"], size, source)
    # middle of the exposure: mean of the start and stop counts
    times = [float(match[2]) for match in _CLOCK.finditer(text)]
    time_s = float(np.mean(times)) if times else None
    name = next((name for name in _POSE_GROUPS if name in label), None)
    if name is None:
        return Pds3Product(counts, None, time_s)
    vectors = []
    for field, length in (("ORIGIN_OFFSET_VECTOR", 3), ("ORIGIN_ROTATION_QUATERNION", 4)):
        value = label[name].get(field) if isinstance(label[name], Mapping) else None
        is_numeric = isinstance(value, list) and all(isinstance(number, int | float) for number in value)
        if not is_numeric or len(value) != length:  # type: ignore[arg-type]  # numeric values are a list
            raise source.error(f"{name}.{field}", f"{value!r}", f"{length} numbers")
        vectors.append(np.array(value, dtype=np.float64))
    offset, quaternion = vectors
    if abs(float(np.linalg.norm(quaternion)) - 1.0) > _QUATERNION_TOLERANCE:
        raise source.error(f"{name}.ORIGIN_ROTATION_QUATERNION", "is not of length 1", "a unit quaternion")
    # the label's quaternion is (w, x, y, z), SciPy's is (x, y, z, w)
    return Pds3Product(counts, rigid(Rotation.from_quat(quaternion[[1, 2, 3, 0]]), offset), time_s)


def is_pds3(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of a PDS3 label or product."""
    return _START.search(head[:_START_BYTES]) is not None


def _read_label(source: Source) -> str:
    """Read the label up to its END line. Raises CameraFileError."""
    for count in (_FIRST_BYTES, MAX_BYTES):
        head = source.read_head(count)
        if not is_pds3(head):
            raise source.error("PDS_VERSION_ID", "missing at the start of the file", "a PDS3 label or product")
        end = _END.search(head)
        if end is not None:
            return head[: end.end()].decode("latin-1")
    raise source.error("END", f"missing in the first {MAX_BYTES} bytes", "a label that ends with a line END")


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


def _create_pds3_camera(group: Any, size: tuple[int, int], source: Source) -> CameraModel:
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
    units = group.get("MODEL_COMPONENT_UNIT", ["N/A"] * len(letters))
    for letter, unit in zip(letters, units, strict=False):
        if letter in ("C", "E") and str(unit).upper() not in _PDS3_METRES:
            raise source.error(f"{_CAMERA_GROUP}.MODEL_COMPONENT_UNIT", f"{unit!r} for {letter}", "METER")
    vectors: dict[str, list[float]] = {}
    lens: dict[str, float] = {}
    for letter in (*name, "T", "P") if name == "CAHVORE" else name:
        if letter not in letters:
            if letter in name:
                raise source.error(id_field, f"has no {letter}", "every letter of the model")
            continue
        keyword = f"MODEL_COMPONENT_{letters.index(letter) + 1}"
        value: Any = group.get(keyword)
        field = f"{_CAMERA_GROUP}.{keyword} ({letter})"
        if letter in name:
            if not isinstance(value, list) or len(value) != 3 or not all(is_number(number) for number in value):
                raise source.error(field, _describe_fault(value), "three finite numbers")
            vectors[letter] = [float(number) for number in value]
        elif not is_number(value):
            raise source.error(field, _describe_fault(value), "a finite number")
        else:
            lens[letter] = float(value)
    if name != "CAHVORE":
        return create_camera(name, vectors, size, None, source)
    linearity = linearity_of_type(lens.get("T"), lens.get("P"), f"{id_field} T, P", source)
    return create_camera(name, vectors, size, linearity, source)


def _describe_fault(value: Any) -> str:
    return "missing" if value is None else f"{value!r}"


def _read_counts(text: str, image: Any, size: tuple[int, int], source: Source) -> UInt16[np.ndarray, "rows columns"]:
    """Read the image's samples at the label's pointer ^IMAGE. Raises CameraFileError."""
    pointer = _POINTER.search(text)
    if pointer is None:
        raise source.error("^IMAGE", "missing or not readable", 'a record, bytes, or ("FILE", record)')
    name = pointer["file"] or pointer["file_only"]
    path = Path(source.path)
    if name is not None:
        if Path(name).name != name:
            raise source.error("^IMAGE", f"{name!r} is in another folder", "a file next to the label")
        # some archives write the file name in lower or upper case
        paths = [path.parent / name, path.parent / name.lower(), path.parent / name.upper()]
        path = next((path for path in paths if path.exists()), paths[0])
    offset = int(pointer["file_position"] or pointer["position"] or 1) - 1
    if offset > 0 and not (pointer["file_in_bytes"] or pointer["in_bytes"]):
        record = _RECORD.search(text)
        if record is None:
            raise source.error("RECORD_BYTES", "missing", "the number of bytes of a record")
        offset *= int(record[1])
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


def is_xml(head: bytes) -> bool:
    """Return whether the first bytes of a file are XML."""
    return _XML_START.match(head) is not None


def read_pds4(path: str | Path, *, subframe_folded_in: bool = False) -> tuple[CameraModel, ...]:
    """Read every camera model of a PDS4 label (.xml or .lblx), in order.

    Raises CameraFileError as `read_pds3` does, also if ground processing cropped or averaged the image. With
    `subframe_folded_in` such images are accepted, and the vectors are assumed to describe the stored image, as in the
    labels of Mars 2020. Images that the camera itself cropped or averaged on command are always accepted.
    """
    source = Source(str(path))
    text = source.read_text()
    if "<!ENTITY" in text:  # labels do not need entities, and nested entities can fill the memory
        raise source.error("label", "declares entities", "a PDS4 label, which has none")
    try:
        root = ElementTree.fromstring(text.encode("latin-1"))  # noqa: S314  (entities are refused above)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise source.error("label", f"cannot be parsed ({error})", "a PDS4 label, which is XML") from error
    models = [model for model in _find_elements(root, _PARAMETERS) if _find_child(model, "model_type") is not None]
    if not models:
        raise source.error(_PARAMETERS, "missing", "a PDS4 label with at least one such class with a model_type")
    arrays = _find_elements(root, "Array_2D_Image", "Array_3D_Image")
    if not arrays:
        raise source.error("Array_2D_Image", "missing", "an image array of lines and samples")
    extents = {}
    for axis in (element for element in arrays[0] if _local_name(element) == "Axis_Array"):
        axis_name, count = _element_text(_find_child(axis, "axis_name")), _find_child(axis, "elements")
        if axis_name in ("Line", "Sample") and count is not None:
            if not (_element_text(count).isdecimal() and int(_element_text(count)) > 0):
                raise source.error("Axis_Array.elements", f"{_element_text(count)!r}", "a positive integer")
            extents[axis_name] = int(_element_text(count))
    if set(extents) != {"Line", "Sample"}:
        raise source.error("Axis_Array", f"names {sorted(extents)}", "the axes Line and Sample")
    size = extents["Sample"], extents["Line"]
    parts = [part for imaging in _find_elements(root, "Imaging") for part in imaging]
    for part in (
        part for part in parts if _local_name(part) in ("Subframe", "Downsampling") and not subframe_folded_in
    ):
        for field in _find_elements(part, "first_line", "first_sample", "height_pixels", "width_pixels"):
            if _element_text(field) not in ("", "1"):
                name = f"{_local_name(part)}.{_local_name(field)}"
                raise source.error(name, f"{_element_text(field)}: {_SUBFRAME}", "1, or subframe_folded_in = true")
    return tuple(_create_pds4_camera(element, size, source) for element in models)


def _local_name(element: ElementTree.Element) -> str:
    """Return an element's name without its namespace."""
    return element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""


def _find_elements(element: ElementTree.Element, *names: str) -> list[ElementTree.Element]:
    return [descendant for descendant in element.iter() if _local_name(descendant) in names]


def _find_child(element: ElementTree.Element, name: str) -> ElementTree.Element | None:
    return next((child for child in element if _local_name(child) == name), None)


def _element_text(element: ElementTree.Element | None) -> str:
    return "" if element is None else (element.text or "").strip()


def _create_pds4_camera(element: ElementTree.Element, size: tuple[int, int], source: Source) -> CameraModel:
    """Create the camera of a class `Camera_Model_Parameters`. Raises CameraFileError."""
    name = _element_text(_find_child(element, "model_type"))
    if name not in MODELS:
        raise source.error(f"{_PARAMETERS}.model_type", f"{name!r}", ", ".join(MODELS))
    class_name = f"{name}_Model"
    model = _find_child(element, class_name)
    if model is None:
        raise source.error(f"{_PARAMETERS}.{class_name}", "missing", "the class that belongs to the model_type")
    vectors: dict[str, list[float]] = {}
    for letter in name:
        vector_name, parts = _VECTORS[letter]
        vector, field = _find_child(model, vector_name), f"{class_name}.{vector_name} ({letter})"
        if vector is None:
            raise source.error(field, "missing", "every vector of the model")
        vectors[letter] = []
        for part in parts:
            number = _parse_number(vector, part, f"{field}.{part}", source)
            if number is None:
                raise source.error(f"{field}.{part}", "missing", "a finite number")
            unit = getattr(_find_child(vector, part), "attrib", {}).get("unit")
            if parts is _POSITION and unit not in _PDS4_METRES:
                raise source.error(f"{field}.{part}", f"is in {unit!r}", "metres (unit m)")
            vectors[letter].append(number)
    if name != "CAHVORE":
        return create_camera(name, vectors, size, None, source)
    field = f"{class_name}.cahvore_model_type, cahvore_model_parameter"
    model_type, parameter = (
        _parse_number(model, f"cahvore_model_{part}", field, source) for part in ("type", "parameter")
    )
    return create_camera(name, vectors, size, linearity_of_type(model_type, parameter, field, source), source)


def _parse_number(element: ElementTree.Element, name: str, field: str, source: Source) -> float | None:
    child = _find_child(element, name)
    if child is None:
        return None
    try:
        return float(_element_text(child))
    except ValueError:
        raise source.error(field, f"{_element_text(child)!r} is not a number", "a finite number") from None
