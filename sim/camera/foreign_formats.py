"""Camera files of known formats that are not read: detection and error message."""

from marsyard.sim.camera.source import FORMATS, Source
from marsyard.sim.camera.xml_files import is_xml, xml_root

#: Names of which a CSM ISD (image support data in JSON) contains at least one.
_ISD_NAMES = (
    b'"name_model"', b'"m_modelName"', b'"isis_camera_version"', b'"name_sensor"', b"USGS_ASTRO", b'"image_lines"',
    b'"detector_sample_summing"', b'"center_ephemeris_time"', b'"body_rotation"',
)  # fmt: skip


def foreign_format(head: bytes) -> str | None:
    """Return the name of a known format that is not read; None for other files."""
    if head.startswith(b"LBLSIZE="):
        return "a VICAR file without a PDS label"
    if is_xml(head):
        root = xml_root(head)
        names = {"document": "a Metashape project", "calibration": "a Metashape calibration", "isd": "a CSM ISD"}
        return names.get(root)
    is_isd = head.lstrip().startswith(b"{") and any(name in head for name in _ISD_NAMES)
    return "a CSM ISD" if is_isd else None


def refuse_foreign(source: Source, head: bytes) -> None:
    """Raise CameraFileError for a known format that is not read; the message lists the supported ones."""
    name = foreign_format(head)
    if name is not None:
        raise source.error("file", f"is {name}, which is not supported", FORMATS)
