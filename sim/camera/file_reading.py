"""Common parts of the readers of camera files: bytes, XML, errors, and the camera of a model's vectors."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from marsyard.sim.camera.base import CameraModel, Number
from marsyard.sim.camera.cahvore import Cahvore
from marsyard.sim.camera.models import Cahv, Cahvor
from marsyard.sim.files import open_regular

#: Maximum size of a camera file; some labels have several megabytes.
MAX_BYTES = 1 << 23
#: Calibrations in OpenCV's terms, for messages; and all camera files.
CALIBRATION_FILES = (
    "a calibration of OpenCV (camera_matrix, distortion_coefficients, image_width, image_height; YAML, JSON or XML), "
    "ROS (the same and distortion_model), Kalibr (cam0: ...) or EuRoC (intrinsics, resolution, ...)"
)
FORMATS = (
    f"a PDS3 or PDS4 label, a JPL text file (Model = CAHVOR, ...), {CALIBRATION_FILES}, COLMAP's cameras.txt, or a "
    "pinhole model of Ames Stereo Pipeline (.tsai)"
)
#: End of the message for images that are refused by default.
SUBFRAME = "of a part of the detector or of averaged pixels"
#: Names of the models; each letter of a name is the name of one of the model's vectors.
MODELS = ("CAHV", "CAHVOR", "CAHVORE")
#: Names of which a CSM ISD (image support data in JSON) contains at least one.
_ISD_NAMES = (
    b'"name_model"', b'"m_modelName"', b'"isis_camera_version"', b'"name_sensor"', b"USGS_ASTRO", b'"image_lines"',
    b'"detector_sample_summing"', b'"center_ephemeris_time"', b'"body_rotation"',
)  # fmt: skip
#: Root elements of XML files that are not read.
_FOREIGN_ROOTS = {"document": "a Metashape project", "calibration": "a Metashape calibration", "isd": "a CSM ISD"}
#: Start of an XML file, and the first element: an optional declaration, comments, and a name with an optional prefix.
_XML_START = re.compile(rb"\A(\xef\xbb\xbf)?\s*<(\?xml|!--|!DOCTYPE|[A-Za-z_][\w:.-]*[\s>/])")
_XML_ROOT = re.compile(rb"<(?:[A-Za-z_][\w.-]*:)?(?P<root>[A-Za-z_][\w.-]*)")
_XML_PROLOGUE = re.compile(rb"<\?.*?\?>|<!--.*?-->", re.DOTALL)


class CameraFileError(ValueError):
    """A camera file that cannot be used. The message contains the file, the field and the allowed values."""


@dataclass(frozen=True)
class Source:
    """Path of a camera file: reads its content and creates error messages."""

    path: str

    def error(self, field: str, fault: str, allowed: str) -> CameraFileError:
        """Create the error for a field."""
        return CameraFileError(f"{self.path}: {field}: {fault}; allowed: {allowed}")

    def read_text(self) -> str:
        """Read the whole file. Raises CameraFileError if it is unreadable, empty or larger than `MAX_BYTES`."""
        contents = self.read_head(MAX_BYTES + 1)
        if len(contents) > MAX_BYTES:
            raise self.error("file", f"is larger than {MAX_BYTES >> 20} MiB", "a camera file or label, not an image")
        return contents.decode("latin-1")

    def read_head(self, count: int) -> bytes:
        """Read at most the first `count` bytes. Raises CameraFileError if the file is unreadable or empty."""
        try:
            with open_regular(self.path) as file:
                first_bytes = file.read(count)
        except OSError as fault:
            raise self.error("file", f"cannot be read ({fault.strerror})", "a readable camera file") from fault
        if not first_bytes:
            raise self.error("file", "is empty (0 bytes)", "a camera file")
        return first_bytes


def is_xml(head: bytes) -> bool:
    """Return whether the first bytes of a file are XML."""
    return _XML_START.match(head) is not None


def xml_root(head: bytes) -> str:
    """Return the name of the first element in the first bytes of an XML file; empty if there is none."""
    match = _XML_ROOT.search(_XML_PROLOGUE.sub(b"", head))
    return "" if match is None else match["root"].decode()


def parse_xml(source: Source, allowed: str) -> ElementTree.Element:
    """Parse an XML file. Raises CameraFileError; `allowed` describes the file."""
    text = source.read_text()
    if "<!ENTITY" in text:  # camera files do not need entities, and nested entities can fill the memory
        raise source.error("label", "declares entities", f"{allowed}, which has none")
    try:
        return ElementTree.fromstring(text.encode("latin-1"))  # noqa: S314  (entities are refused above)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise source.error("label", f"cannot be parsed ({error})", f"{allowed}, which is XML") from error


def refuse_foreign(source: Source, head: bytes) -> None:
    """Raise CameraFileError for a known format that is not read; the message lists the supported ones."""
    name = None
    if head.startswith(b"LBLSIZE="):
        name = "a VICAR file without a PDS label"
    elif is_xml(head):
        name = _FOREIGN_ROOTS.get(xml_root(head))
    elif head.lstrip().startswith(b"{") and any(name in head for name in _ISD_NAMES):
        name = "a CSM ISD"
    if name is not None:
        raise source.error("file", f"is {name}, which is not supported", FORMATS)


def linearity_of_type(kind: Number | None, parameter: float | None, field: str, source: Source) -> float:
    """Return CAHVORE's linearity: 1 for type 1 (perspective), 0 for type 2 (fish-eye), `parameter` for type 3."""
    if kind in (1, 2):
        return 1.0 if kind == 1 else 0.0
    if kind != 3:
        raise source.error(field, f"CAHVORE's type is {'missing' if kind is None else kind}", "type 1, 2 or 3")
    if parameter is None:
        raise source.error(field, "CAHVORE of type 3 has no parameter", "type 3 with its linearity, from -1 to 1")
    return parameter


def create_camera(
    name: str, vectors: Mapping[str, Sequence[float]], size: tuple[int, int], linearity: float | None, source: Source
) -> CameraModel:
    """Create the camera of a model's name and its vectors by letter. Raises CameraFileError for impossible values."""
    c, a, h, v, *lens = (np.array(vectors[letter], dtype=np.float64) for letter in name)
    try:
        if linearity is not None:
            return Cahvore(c, a, h, v, lens[0], lens[1], lens[2], linearity=linearity, size=size)
        return Cahvor(c, a, h, v, lens[0], lens[1], size) if lens else Cahv(c, a, h, v, size)
    except ValueError as fault:
        field, allowed = str(fault).partition(" ")[0].upper(), "a camera model of unit A and O and independent H, V, A"
        raise source.error(field, str(fault), allowed) from fault
