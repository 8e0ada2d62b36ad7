"""Camera models in PDS4 labels: the class `geom:Camera_Model_Parameters` of the geometry dictionary.

Vectors are returned in the frame named by the label (`Coordinate_Space_Reference`). The picture's size is that of the
label's image array. Prefixes and versions of namespaces do not matter.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

from marsyard.sim.camera.assembly import MODELS, Source, create_camera, linearity_of_type
from marsyard.sim.camera.base import CameraModel

_START = re.compile(rb"\A(\xef\xbb\xbf)?\s*<(\?xml|[A-Za-z_][\w:.-]*[\s>])")
_PARAMETERS = "Camera_Model_Parameters"
_POSITION = ("x_position", "y_position", "z_position")
_UNIT = ("x_unit", "y_unit", "z_unit")
_PIXEL = ("x_pixel", "y_pixel", "z_pixel")
_TERMS = ("c0", "c1", "c2")
#: Element and components of each vector of a model.
_VECTORS = {
    "C": ("Vector_Center", _POSITION),
    "A": ("Vector_Axis", _UNIT),
    "H": ("Vector_Horizontal", _PIXEL),
    "V": ("Vector_Vertical", _PIXEL),
    "O": ("Vector_Optical", _UNIT),
    "R": ("Radial_Terms", _TERMS),
    "E": ("Entrance_Terms", _TERMS),
}
_METRES = (None, "m", "meter", "metre")


def is_xml(head: bytes) -> bool:
    """Whether the first bytes of a file are XML."""
    return _START.match(head) is not None


def read_pds4(path: str | Path, *, subframe_folded_in: bool = False) -> tuple[CameraModel, ...]:
    """Read every camera model of a PDS4 label (.xml or .lblx), in order.

    The standard does not define whether the model of a subframe, or of a picture with averaged pixels, describes the
    stored picture or the whole detector. Such labels are refused unless `subframe_folded_in` is set: the vectors then
    describe the stored picture, as those of Mars 2020 do. Raises CameraFileError if the label cannot be read, has no
    camera model, or one is incomplete or wrong; it names file, field and allowed values.
    """
    source = Source(str(path))
    root = _parse(source)
    models = [one for one in root.iter() if _local(one) == _PARAMETERS and _child(one, "model_type") is not None]
    if not models:
        raise source.error(_PARAMETERS, "missing", "a PDS4 label with at least one such class that states a model_type")
    size = _size(root, source)
    if not subframe_folded_in:
        _refuse_subframes(root, source)
    return tuple(_camera(element, size, source) for element in models)


def _parse(source: Source) -> ElementTree.Element:
    text = source.text()
    if "<!ENTITY" in text:  # labels need none, and nested entities fill the memory
        raise source.error("label", "declares entities", "a PDS4 label, which has none")
    try:
        return ElementTree.fromstring(text.encode("latin-1"))  # noqa: S314  (entities are refused above)
    except (ElementTree.ParseError, ValueError, LookupError) as fault:
        raise source.error("label", f"cannot be parsed ({fault})", "a PDS4 label, which is XML") from fault


def _local(element: ElementTree.Element) -> str:
    """An element's name without its namespace."""
    return element.tag.rpartition("}")[2] if isinstance(element.tag, str) else ""


def _child(element: ElementTree.Element, name: str) -> ElementTree.Element | None:
    return next((one for one in element if _local(one) == name), None)


def _size(root: ElementTree.Element, source: Source) -> tuple[int, int]:
    """Samples and lines of the image array."""
    arrays = [one for one in root.iter() if _local(one) in ("Array_2D_Image", "Array_3D_Image")]
    if not arrays:
        raise source.error("Array_2D_Image", "missing", "an image array of lines and samples")
    extents = {}
    for axis in (one for one in arrays[0] if _local(one) == "Axis_Array"):
        name, count = (_child(axis, part) for part in ("axis_name", "elements"))
        if name is not None and count is not None and (name.text or "").strip() in ("Line", "Sample"):
            text = (count.text or "").strip()
            if not (text.isdecimal() and int(text) > 0):
                raise source.error("Axis_Array.elements", f"{text!r}", "a positive integer")
            extents[(name.text or "").strip()] = int(text)
    if set(extents) != {"Line", "Sample"}:
        raise source.error("Axis_Array", f"names {sorted(extents)}", "the axes Line and Sample")
    return extents["Sample"], extents["Line"]


def _refuse_subframes(root: ElementTree.Element, source: Source) -> None:
    """Raise CameraFileError for a subframe or averaged pixels in the picture's own processing, not in the command."""
    for imaging in (one for one in root.iter() if _local(one) == "Imaging"):
        for part in imaging:
            if _local(part) not in ("Subframe", "Downsampling"):
                continue
            fields = ("first_line", "first_sample", "height_pixels", "width_pixels")
            for field in (one for one in part.iter() if _local(one) in fields):
                if (field.text or "").strip() not in ("", "1"):
                    raise source.error(
                        f"{_local(part)}.{_local(field)}",
                        f"{(field.text or '').strip()}: of a part of the detector or of averaged pixels",
                        "1, or subframe_folded_in = true",
                    )


def _camera(element: ElementTree.Element, size: tuple[int, int], source: Source) -> CameraModel:
    kind = _child(element, "model_type")
    name = "" if kind is None else (kind.text or "").strip()
    if name not in MODELS:
        raise source.error(f"{_PARAMETERS}.model_type", f"{name!r}", ", ".join(MODELS))
    model = _child(element, f"{name}_Model")
    if model is None:
        raise source.error(f"{_PARAMETERS}.{name}_Model", "missing", "the class that the model_type names")
    vectors = {letter: _vector(model, letter, f"{name}_Model", source) for letter in name}
    linearity = None
    if name == "CAHVORE":
        where = f"{name}_Model.cahvore_model_type, cahvore_model_parameter"
        kinds = [_number(model, part, where, source) for part in ("cahvore_model_type", "cahvore_model_parameter")]
        linearity = linearity_of_type(kinds[0], kinds[1], where, source)
    return create_camera(name, vectors, size, linearity, source)


def _vector(model: ElementTree.Element, letter: str, where: str, source: Source) -> list[float]:
    name, parts = _VECTORS[letter]
    element = _child(model, name)
    field = f"{where}.{name} ({letter})"
    if element is None:
        raise source.error(field, "missing", "every vector of the model")
    vector = []
    for part in parts:
        number = _number(element, part, f"{field}.{part}", source)
        if number is None:
            raise source.error(f"{field}.{part}", "missing", "a finite number")
        unit = getattr(_child(element, part), "attrib", {}).get("unit")
        if parts is _POSITION and unit not in _METRES:
            raise source.error(f"{field}.{part}", f"is in {unit!r}", "metres (unit m)")
        vector.append(number)
    return vector


def _number(element: ElementTree.Element, name: str, where: str, source: Source) -> float | None:
    """A number of an element; None if missing."""
    child = _child(element, name)
    if child is None:
        return None
    text = (child.text or "").strip()
    try:
        return float(text)
    except ValueError:
        raise source.error(where, f"{text!r} is not a number", "a finite number") from None
