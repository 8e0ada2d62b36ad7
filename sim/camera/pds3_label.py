"""PDS3 labels: text, parsed groups and objects, size and position of the image, and definitions of frames.

Labels are attached to the product or detached; Curiosity's begin with ODL_VERSION_ID. Groups such as
ROVER_COORDINATE_SYSTEM define the transforms between frames (`marsyard.sim.camera.label_frames`).
"""

import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from marsyard.sim.camera.label_frames import ROVER_FRAME, SITE, CoordinateSystem, LabelFrame, transform_from_label
from marsyard.sim.camera.source import MAX_BYTES, Source

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
FRAME_GROUPS = {
    f"{name}_COORDINATE_SYSTEM{end}": (name, reference)
    for name, reference in (("ROVER", SITE), ("LANDER", SITE), ("SITE", SITE), ("LOCAL_LEVEL", SITE))
    for end in ("", "_PARMS")
}
#: Values of numbers that are not known.
_UNKNOWN = ("UNK", "N/A", "NULL")
#: The pointer ^IMAGE, on one line or several, with one of `9`, `20481 <BYTES>`, `"A.IMG"`, `("A.IMG")`, `("A.IMG", 9)`,
#: `("A.IMG", 20481 <BYTES>)`: the image's file, and its first record or byte (counted from 1).
POINTER = re.compile(
    r"^[ \t]*\^IMAGE\s*=\s*(?P<list>\()?\s*(?:[\"'](?P<file>[^\"'\n]+)[\"']\s*)?(?(file)(?:,\s*)?)"
    r"(?:(?P<position>\d+)\s*(?P<in_bytes><\s*BYTES?\s*>)?\s*)?(?(list)\))[ \t]*(?:/\*|\r?$)",
    re.MULTILINE | re.IGNORECASE,
)
_RECORD = re.compile(r"^[ \t]*RECORD_BYTES[ \t]*=[ \t]*(\d+)", re.MULTILINE)


def read_frame(group: Any, kind: str, default: str = ROVER_FRAME.name) -> LabelFrame:
    """Read the frame of a group: its own (kind COORDINATE) or the one that it refers to (kind REFERENCE)."""
    prefix = "COORDINATE_SYSTEM" if kind == "COORDINATE" else "REFERENCE_COORD_SYSTEM"
    name, indices = group.get(f"{prefix}_NAME"), group.get(f"{prefix}_INDEX", [])
    indices = indices if isinstance(indices, list) else [indices]
    is_known = all(isinstance(index, int) for index in indices)
    return LabelFrame.of(name if isinstance(name, str) else default, indices if is_known else ())


def read_systems(label: Any, source: Source) -> list[CoordinateSystem]:
    """Read the definitions of frames, except those whose values are unknown. Raises CameraFileError."""
    systems = []
    for name, group in label.items():
        if name not in FRAME_GROUPS or not isinstance(group, Mapping):
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
            own, reference = FRAME_GROUPS[name]
            frames = read_frame(group, "COORDINATE", own), read_frame(group, "REFERENCE", reference)
            systems.append(CoordinateSystem(*frames, transform))
    return systems


def is_pds3(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of a PDS3 label or product."""
    return _START.search(head[:_START_BYTES]) is not None


def read_label(source: Source) -> str:
    """Read the label up to its END line. Raises CameraFileError."""
    for count in (_FIRST_BYTES, MAX_BYTES):
        head = source.read_head(count)
        if not is_pds3(head):
            raise source.error("PDS_VERSION_ID", "missing at the start of the file", "a PDS3 label or product")
        end = _END.search(head) or (_END_OF_HEAD.search(head) if len(head) < count else None)
        text = head[: len(head) if end is None else end.end()].decode("latin-1")
        if end is None:  # the image can follow END without a line break
            pointer = POINTER.search(text)
            if pointer is None or pointer["file"] or not (pointer["in_bytes"] or _RECORD.search(text)):
                continue
            end = _END_OF_HEAD.search(head[: image_offset(pointer, text, source)])
            text = text[: 0 if end is None else end.end()]
        if end is not None:
            return text
    raise source.error("END", f"missing in the first {MAX_BYTES} bytes", "a label that ends with a line END")


def image_offset(pointer: re.Match[str], text: str, source: Source) -> int:
    """Return the number of bytes before the image. Raises CameraFileError if the length of a record is missing."""
    offset = int(pointer["position"] or 1) - 1
    if offset > 0 and not pointer["in_bytes"]:
        record = _RECORD.search(text)
        if record is None:
            raise source.error("RECORD_BYTES", "missing", "the number of bytes of a record")
        offset *= int(record[1])
    return offset


def parse_blocks(text: str, names: Sequence[str], source: Source) -> Any:
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


def read_size(label: Any, source: Source) -> tuple[int, int]:
    """Read (columns, rows) of the label's IMAGE object. Raises CameraFileError."""
    if "IMAGE" not in label or not isinstance(label["IMAGE"], Mapping):
        raise source.error("IMAGE", "missing", "an object with LINES and LINE_SAMPLES")
    image = label["IMAGE"]
    extents = []
    for field in ("LINE_SAMPLES", "LINES"):
        value = image.get(field)
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise source.error(f"IMAGE.{field}", describe_fault(value), "a positive integer")
        extents.append(value)
    return extents[0], extents[1]


def describe_fault(value: Any) -> str:
    """Describe the value of a keyword in an error message; None is a missing keyword."""
    return "missing" if value is None else f"{value!r}"
