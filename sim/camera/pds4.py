"""Reader of PDS4 labels: camera models.

The class `geom:Camera_Model_Parameters` of the geometry dictionary contains a model in the frame that its
`Coordinate_Space_Reference` names; `Coordinate_Space_Definition` defines frames. The image's size is that of the
label's image array. Prefixes and versions of namespaces are ignored.
"""

import re
from pathlib import Path
from xml.etree import ElementTree

from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.file_reading import MODELS, SUBFRAME, Source, create_camera, linearity_of_type, parse_xml
from marsyard.sim.camera.label_frames import (
    ROVER_FRAME,
    CoordinateSystem,
    FramedCamera,
    LabelFrame,
    resolve_camera,
    transform_from_label,
)

#: Names in the geometry dictionary.
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
_QUATERNION = ("qcos", "qsin1", "qsin2", "qsin3")
#: Directions of a definition's quaternion: from the defined frame to its reference, or the inverse.
_FORWARD, _REVERSE = "Forward", "Reverse"
#: Identifier of a frame, for example ROVER_NAV_FRAME_30_1344_4_TELEMETRY: name and indices.
_IDENTIFIER = re.compile(r"(?P<name>[A-Za-z]\w*?)(?P<indices>(?:_\d+)+)(?:_[A-Za-z]+)?")


def read_pds4(path: str | Path, *, subframe_folded_in: bool = False) -> tuple[FramedCamera, ...]:
    """Read every camera model of a PDS4 label (.xml or .lblx), in order, in the frames that `read_pds3` chooses.

    Raises CameraFileError as `read_pds3` does, also if ground processing cropped or averaged the image. With
    `subframe_folded_in` such images are accepted, and the vectors are assumed to describe the stored image, as in the
    labels of Mars 2020. Images that the camera itself cropped or averaged on command are always accepted.
    """
    source = Source(str(path))
    root = parse_xml(source, "a PDS4 label")
    models = [model for model in _find_elements(root, _PARAMETERS) if model.find("{*}model_type") is not None]
    if not models:
        raise source.error(_PARAMETERS, "missing", "a PDS4 label with at least one such class with a model_type")
    size = _read_size(root, source)
    if not subframe_folded_in:
        _refuse_subframe(root, source)
    systems, identified = _read_systems(root, source)
    reference = "Coordinate_Space_Reference"
    return tuple(
        resolve_camera(
            _create_pds4_camera(element, size, source),
            _read_frame(element.find(f"{{*}}{reference}"), identified, None) or ROVER_FRAME,
            systems,
            f"{_PARAMETERS}.{reference}",
            source,
        )
        for element in models
    )


def _read_size(root: ElementTree.Element, source: Source) -> tuple[int, int]:
    """Read (columns, rows) of the label's first image array. Raises CameraFileError."""
    arrays = _find_elements(root, "Array_2D_Image", "Array_3D_Image")
    if not arrays:
        raise source.error("Array_2D_Image", "missing", "an image array of lines and samples")
    extents = {}
    for axis in (element for element in arrays[0] if _local_name(element) == "Axis_Array"):
        axis_name, count = _element_text(axis.find("{*}axis_name")), axis.find("{*}elements")
        if axis_name in ("Line", "Sample") and count is not None:
            if not (_element_text(count).isdecimal() and int(_element_text(count)) > 0):
                raise source.error("Axis_Array.elements", f"{_element_text(count)!r}", "a positive integer")
            extents[axis_name] = int(_element_text(count))
    if set(extents) != {"Line", "Sample"}:
        raise source.error("Axis_Array", f"names {sorted(extents)}", "the axes Line and Sample")
    return extents["Sample"], extents["Line"]


def _refuse_subframe(root: ElementTree.Element, source: Source) -> None:
    """Raise CameraFileError for the label of an image that ground processing cropped or averaged."""
    parts = [part for imaging in _find_elements(root, "Imaging") for part in imaging]
    for part in (part for part in parts if _local_name(part) in ("Subframe", "Downsampling")):
        for field in _find_elements(part, "first_line", "first_sample", "height_pixels", "width_pixels"):
            if _element_text(field) not in ("", "1"):
                name = f"{_local_name(part)}.{_local_name(field)}"
                raise source.error(name, f"{_element_text(field)}: {SUBFRAME}", "1, or subframe_folded_in = true")


def _read_systems(root: ElementTree.Element, source: Source) -> tuple[list[CoordinateSystem], dict[str, LabelFrame]]:
    """Read the definitions of frames, and the frames by local identifier. Raises CameraFileError."""
    definitions = []
    identified: dict[str, LabelFrame] = {}
    for element in _find_elements(root, "Coordinate_Space_Definition"):
        identifiers = [_element_text(child) for child in element if _local_name(child) == "local_identifier"]
        default = _parse_identifier(identifiers[0]) if identifiers else None
        frame = _read_frame(element.find("{*}Coordinate_Space_Present"), {}, default)
        if frame is not None:
            identified |= dict.fromkeys(identifiers, frame)
            definitions.append((element, frame))
    systems = []
    for element, frame in definitions:
        reference = _read_frame(element.find("{*}Coordinate_Space_Reference"), identified, None)
        offset, rotation = (
            element.find(f"{{*}}{name}") for name in ("Vector_Origin_Offset", "Quaternion_Plus_Direction")
        )
        if reference is None or offset is None or rotation is None:
            continue  # not the definition of a transform
        field = f"Coordinate_Space_Definition ({frame})"
        numbers = [
            _parse_number(parent, part, f"{field}.{part}", source)
            for parent, parts in ((offset, _POSITION), (rotation, _QUATERNION))
            for part in parts
            if _element_text(parent.find(f"{{*}}{part}"))
        ]
        if len(numbers) < len(_POSITION + _QUATERNION):
            continue  # without values, for example of an arm that was not measured
        units = {getattr(offset.find(f"{{*}}{part}"), "attrib", {}).get("unit") for part in _POSITION}
        direction = _element_text(rotation.find("{*}rotation_direction")) or _FORWARD
        if not units <= set(_PDS4_METRES):
            raise source.error(f"{field}.Vector_Origin_Offset", f"is in {units}", "metres (unit m)")
        if direction not in (_FORWARD, _REVERSE):
            raise source.error(f"{field}.rotation_direction", f"{direction!r}", f"{_FORWARD} or {_REVERSE}")
        x, y, z, qcos, *qsin = (number for number in numbers if number is not None)
        sign = 1.0 if direction == _FORWARD else -1.0
        quaternion = [qcos, *(sign * number for number in qsin)]
        systems.append(CoordinateSystem(frame, reference, transform_from_label((x, y, z), quaternion, field, source)))
    return systems, identified


def _read_frame(
    element: ElementTree.Element | None, identified: dict[str, LabelFrame], default: LabelFrame | None
) -> LabelFrame | None:
    """Read the frame of a reference: named with indices, by a SPICE name, or by the identifier of a definition."""
    if element is None:
        return default
    for child in _find_elements(element, "coordinate_space_frame_type", "frame_spice_name"):
        indices = [_element_text(index) for index in _find_elements(element, "index_value_number")]
        is_known = all(index.isdecimal() for index in indices)
        return LabelFrame.of(_element_text(child), [int(index) for index in indices] if is_known else ())
    for child in _find_elements(element, "local_identifier_reference"):
        return identified.get(_element_text(child)) or _parse_identifier(_element_text(child))
    return default


def _parse_identifier(identifier: str) -> LabelFrame:
    match = _IDENTIFIER.fullmatch(identifier)
    if match is None:
        return LabelFrame.of(identifier)
    return LabelFrame.of(match["name"], [int(index) for index in match["indices"].split("_")[1:]])


def _find_elements(element: ElementTree.Element, *names: str) -> list[ElementTree.Element]:
    """Return the descendants with these names in any namespace, in the order of the label."""
    return [descendant for descendant in element.iter() if _local_name(descendant) in names]


def _local_name(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]


def _element_text(element: ElementTree.Element | None) -> str:
    return "" if element is None else (element.text or "").strip()


def _create_pds4_camera(element: ElementTree.Element, size: tuple[int, int], source: Source) -> CameraModel:
    """Create the camera of a class `Camera_Model_Parameters`. Raises CameraFileError."""
    name = _element_text(element.find("{*}model_type"))
    if name not in MODELS:
        raise source.error(f"{_PARAMETERS}.model_type", f"{name!r}", ", ".join(MODELS))
    class_name = f"{name}_Model"
    model = element.find(f"{{*}}{class_name}")
    if model is None:
        raise source.error(f"{_PARAMETERS}.{class_name}", "missing", "the class that belongs to the model_type")
    vectors: dict[str, list[float]] = {}
    for letter in name:
        vector_name, parts = _VECTORS[letter]
        vector, field = model.find(f"{{*}}{vector_name}"), f"{class_name}.{vector_name} ({letter})"
        if vector is None:
            raise source.error(field, "missing", "every vector of the model")
        vectors[letter] = []
        for part in parts:
            number = _parse_number(vector, part, f"{field}.{part}", source)
            if number is None:
                raise source.error(f"{field}.{part}", "missing", "a finite number")
            unit = getattr(vector.find(f"{{*}}{part}"), "attrib", {}).get("unit")
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
    child = element.find(f"{{*}}{name}")
    if child is None:
        return None
    try:
        return float(_element_text(child))
    except ValueError:
        raise source.error(field, f"{_element_text(child)!r} is not a number", "a finite number") from None
