"""Reader of the camera models in PDS3 labels.

Each group GEOMETRIC_CAMERA_MODEL (Curiosity: GEOMETRIC_CAMERA_MODEL_PARMS) contains MODEL_TYPE, the letters of the
components (MODEL_COMPONENT_ID) and the components, in the frame named by REFERENCE_COORD_SYSTEM_NAME (by default the
rover's frame, metres: x forward, y right, z down). The image's size is that of the label's IMAGE object.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.label_frames import FramedCamera, resolve_camera
from marsyard.sim.camera.pds3_label import (
    FRAME_GROUPS,
    describe_fault,
    parse_blocks,
    read_frame,
    read_label,
    read_size,
    read_systems,
)
from marsyard.sim.camera.source import MODELS, SUBFRAME, Source, create_camera, linearity_of_type

#: PDS3: group of a camera model, and its two names.
_CAMERA_GROUP = "GEOMETRIC_CAMERA_MODEL"
_CAMERA_GROUPS = (_CAMERA_GROUP, f"{_CAMERA_GROUP}_PARMS")
#: Units of C and E that are metres; without a unit, metres are assumed.
_PDS3_METRES = ("METER", "METERS", "METRE", "METRES", "M", "N/A")


def read_pds3(path: str | Path, *, subframe_folded_in: bool = False) -> tuple[CameraModel, ...]:
    """Read every camera model of a PDS3 product (.IMG) or detached label (.LBL), in order; the image is not read.

    The standard does not define whether the model of a subframe, or of an image with averaged pixels, describes the
    stored image or the whole detector. Such labels are refused by default. With `subframe_folded_in` they are accepted,
    and the vectors are assumed to describe the stored image. Models are returned in the frame that `read_pds3_framed`
    chooses. Raises CameraFileError if the label cannot be read or has no camera model, or if a model is incomplete or
    wrong. The message contains file, field and allowed values.
    """
    return tuple(framed.camera for framed in read_pds3_framed(path, subframe_folded_in=subframe_folded_in))


def read_pds3_framed(path: str | Path, *, subframe_folded_in: bool = False) -> tuple[FramedCamera, ...]:
    """Read every camera model as `read_pds3` does, and the frames in which they are returned.

    This is the rover's frame if the label contains the transform to it, else the site's or the Mars-fixed frame. Raises
    CameraFileError also if the label contains none of these transforms.
    """
    source = Source(str(path))
    label = parse_blocks(
        read_label(source), (*_CAMERA_GROUPS, *FRAME_GROUPS, "IMAGE", "INSTRUMENT_STATE_PARMS"), source
    )
    groups = [group for name, group in label.items() if name in _CAMERA_GROUPS]
    if not groups:
        raise source.error(_CAMERA_GROUP, "missing or not closed", "a label with at least one such group")
    size = read_size(label, source)
    fields = {f"IMAGE.{field}": label["IMAGE"].get(field) for field in ("FIRST_LINE", "FIRST_LINE_SAMPLE")}
    state = label.get("INSTRUMENT_STATE_PARMS")
    if isinstance(state, Mapping):
        for field in ("PIXEL_AVERAGING_HEIGHT", "PIXEL_AVERAGING_WIDTH"):
            fields[f"INSTRUMENT_STATE_PARMS.{field}"] = state.get(field)
    for field, quantity in fields.items():
        value = getattr(quantity, "value", quantity)  # pvl parses 2 <pixel> to an object with value and unit
        if not subframe_folded_in and isinstance(value, int) and value != 1:
            raise source.error(field, f"{value}: {SUBFRAME}", "1, or subframe_folded_in=True")
    systems = read_systems(label, source)
    field = f"{_CAMERA_GROUP}.REFERENCE_COORD_SYSTEM_NAME"
    return tuple(
        resolve_camera(_create_pds3_camera(group, size, source), read_frame(group, "REFERENCE"), systems, field, source)
        for group in groups
    )


def _create_pds3_camera(group: Any, size: tuple[int, int], source: Source) -> CameraModel:
    """Create the camera of a group; the letters in MODEL_COMPONENT_ID assign its components to vectors."""

    def is_number(value: Any) -> bool:
        return isinstance(value, int | float) and not isinstance(value, bool)

    if not isinstance(group, Mapping):
        raise source.error(_CAMERA_GROUP, "is not a group", "GROUP = GEOMETRIC_CAMERA_MODEL ... END_GROUP")
    name, letters = group.get("MODEL_TYPE"), group.get("MODEL_COMPONENT_ID")
    id_field = f"{_CAMERA_GROUP}.MODEL_COMPONENT_ID"
    if not isinstance(name, str) or name not in MODELS:
        raise source.error(f"{_CAMERA_GROUP}.MODEL_TYPE", describe_fault(name), ", ".join(MODELS))
    if not isinstance(letters, list) or not all(isinstance(letter, str) for letter in letters):
        raise source.error(id_field, describe_fault(letters), "a list of letters such as (C,A,H,V,O,R)")
    if len(set(letters)) != len(letters):
        raise source.error(id_field, f"{letters} repeats a letter", "each letter once")
    units = group.get("MODEL_COMPONENT_UNIT", ["N/A"] * len(letters))
    for letter, unit in zip(letters, units, strict=False):
        if letter in ("C", "E") and str(unit).upper() not in _PDS3_METRES:
            raise source.error(f"{_CAMERA_GROUP}.MODEL_COMPONENT_UNIT", f"{unit!r} for {letter}", "METER")
    vectors: dict[str, list[float]] = {}
    for letter in name:
        if letter not in letters:
            raise source.error(id_field, f"has no {letter}", "every letter of the model")
        keyword = f"MODEL_COMPONENT_{letters.index(letter) + 1}"
        value: Any = group.get(keyword)
        if not isinstance(value, list) or len(value) != 3 or not all(is_number(number) for number in value):
            raise source.error(f"{_CAMERA_GROUP}.{keyword} ({letter})", describe_fault(value), "three finite numbers")
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
            raise source.error(field, describe_fault(value), "a finite number")
        return float(value)

    lens_type = read_lens("T", 8)
    parameter = read_lens("P", 9) if lens_type == 3 else None
    return create_camera(
        name, vectors, size, linearity_of_type(lens_type, parameter, f"{id_field} T, P", source), source
    )
