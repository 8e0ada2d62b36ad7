"""Camera models in PDS3 labels: the GEOMETRIC_CAMERA_MODEL groups of attached and detached labels.

Each group gives MODEL_TYPE, the letters of its components (MODEL_COMPONENT_ID) and the components themselves, in the
frame named by REFERENCE_COORD_SYSTEM_NAME (a rover's frame, metres: x forward, y right, z down); the vectors are
returned in that frame as they are. The picture's size is that of the label's IMAGE object. Curiosity's labels begin
with ODL_VERSION_ID and name the group GEOMETRIC_CAMERA_MODEL_PARMS.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from marsyard.sim.camera.assembly import MODELS, Source, assembled, linearity_of_type
from marsyard.sim.camera.base import CameraModel

_GROUP = "GEOMETRIC_CAMERA_MODEL"
_FIRST_BYTES = 1 << 16
_MOST_BYTES = 1 << 23
_START = re.compile(rb"^\s*(?:PDS|ODL)_VERSION_ID\s*=", re.MULTILINE)
_START_WITHIN = 4096
_END = re.compile(rb"^END\s*$", re.MULTILINE)
_GROUPS = (_GROUP, f"{_GROUP}_PARMS")
_BLOCKS = (*_GROUPS, "IMAGE", "INSTRUMENT_STATE_PARMS")
_METRES = ("METER", "METERS", "METRE", "METRES", "M", "N/A")


def read_pds3(path: str | Path, *, subframe_folded_in: bool = False) -> tuple[CameraModel, ...]:
    """Read every camera model of a PDS3 product or label, in the label's order; of the image nothing is read.

    Parameters
    ----------
    path
        A product with an attached label (.IMG) or a detached label (.LBL).
    subframe_folded_in
        The standard does not say whether the model of a subframe, or of a picture with averaged pixels, describes the
        stored picture or the whole detector. Such labels are refused unless this is set, which takes the vectors to
        describe the stored picture.

    Raises
    ------
    CameraFileError
        If the label cannot be read, has no camera model, or one is incomplete or wrong; it names file, field and what
        is allowed.
    """
    source = Source(str(path))
    label = parsed_blocks(label_text(source), _BLOCKS, source)
    groups = [group for name, group in label.items() if name in _GROUPS]
    if not groups:
        raise source.error(_GROUP, "missing or not closed", "a label with at least one such group")
    size = picture_size(label, source)
    if not subframe_folded_in:
        _refuse_subframes(label, source)
    return tuple(_camera(group, size, source) for group in groups)


def is_pds3(head: bytes) -> bool:
    """Whether a file that begins so is a PDS3 label or product."""
    return _START.search(head[:_START_WITHIN]) is not None


def label_text(source: Source) -> str:
    """The text of a PDS3 label, having read no further than its END. Raises CameraFileError where there is none."""
    head = source.head(_FIRST_BYTES)
    if not is_pds3(head):
        raise source.error("PDS_VERSION_ID", "missing at the head of the file", "a PDS3 label or product")
    end = _END.search(head)
    if end is None:
        head = source.head(_MOST_BYTES)
        end = _END.search(head)
    if end is None:
        raise source.error("END", f"missing in the first {_MOST_BYTES} bytes", "a label closed by a line END")
    return head[: end.end()].decode("latin-1")


def parsed_blocks(text: str, names: Sequence[str], source: Source) -> Any:
    """The groups and objects of these names in a label, parsed. Raises CameraFileError where they cannot be.

    pvl's strict parser refuses what real labels hold elsewhere (values that begin with a digit and have no quotes), and
    its lenient one never returns from some damaged labels; the blocks are regular.
    """
    blocks = re.compile(
        rf"^[ \t]*(GROUP|OBJECT)[ \t]*=[ \t]*({'|'.join(names)})[ \t]*\r?$.*?^[ \t]*END_\1\b[^\n]*$",
        re.MULTILINE | re.DOTALL,
    )
    try:
        return _parsed("\n".join(block[0] for block in blocks.finditer(text)) + "\nEND\n")
    except Exception as fault:  # pvl raises many kinds, of its own and of Python's
        raise source.error("label", f"cannot be parsed ({fault})", "a PDS3 label") from fault


def _parsed(text: str) -> Any:
    with warnings.catch_warnings():
        # What pvl says of itself: an optional package is missing, and a class that it uses itself is deprecated.
        warnings.simplefilter("ignore", ImportWarning)
        warnings.simplefilter("ignore", PendingDeprecationWarning)
        from pvl.decoder import PDSLabelDecoder
        from pvl.grammar import PDSGrammar
        from pvl.parser import ODLParser

        grammar = PDSGrammar()
        return ODLParser(grammar=grammar, decoder=PDSLabelDecoder(grammar=grammar)).parse(text)


def picture_size(label: Any, source: Source) -> tuple[int, int]:
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
        value = getattr(stated, "value", stated)  # of a quantity with its unit, as 2 <pixel>
        if isinstance(value, int) and value != 1:
            raise source.error(
                field, f"{value}: of a part of the detector or of averaged pixels", "1, or subframe_folded_in=True"
            )


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
    return assembled(name, vectors, size, linearity, source)


def _components(group: Any, source: Source) -> dict[str, tuple[str, Any]]:
    """Name of the keyword and value of each component, by its letter."""
    letters = group.get("MODEL_COMPONENT_ID")
    if not isinstance(letters, list) or not all(isinstance(letter, str) for letter in letters):
        raise source.error(f"{_GROUP}.MODEL_COMPONENT_ID", _fault(letters), "a list of letters such as (C,A,H,V,O,R)")
    if len(set(letters)) != len(letters):
        raise source.error(f"{_GROUP}.MODEL_COMPONENT_ID", f"{letters} repeats a letter", "each letter once")
    units = group.get("MODEL_COMPONENT_UNIT", ["N/A"] * len(letters))
    for letter, unit in zip(letters, units, strict=False):
        if letter in ("C", "E") and str(unit).upper() not in _METRES:
            raise source.error(f"{_GROUP}.MODEL_COMPONENT_UNIT", f"{unit!r} for {letter}", "METER")
    keywords = (f"MODEL_COMPONENT_{number}" for number in range(1, len(letters) + 1))
    return {
        letter: (f"{_GROUP}.{keyword}", group.get(keyword)) for letter, keyword in zip(letters, keywords, strict=True)
    }


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
