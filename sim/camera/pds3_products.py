"""PDS3 products: the image, the rover's pose and the time of the exposure."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt16
from scipy.spatial.transform import RigidTransform

from marsyard.sim.camera.label_frames import LabelFrame, find_pose
from marsyard.sim.camera.pds3_label import (
    FRAME_GROUPS,
    POINTER,
    image_offset,
    parse_blocks,
    read_label,
    read_size,
    read_systems,
)
from marsyard.sim.camera.source import Source
from marsyard.sim.files import check_regular

_CLOCK = re.compile(r"^[ \t]*SPACECRAFT_CLOCK_(START|STOP)_COUNT[ \t]*=[ \t]*\"?(\d+\.?\d*)\"?[ \t]*\r?$", re.MULTILINE)
#: Byte orders of integer samples by the first word of SAMPLE_TYPE; for 8-bit samples the order has no effect.
_BYTE_ORDERS = {"MSB": ">", "LSB": "<", "PC": "<", "SUN": ">", "UNSIGNED": ">", "INTEGER": ">"}


@dataclass(frozen=True)
class Pds3Product:
    """An image of a rover with the rover's pose and the time from the image's label.

    - counts: the stored numbers of the pixels, DN
    - pose: frame of reference (a site's or the Mars-fixed frame) and the rover's pose in it, metres; None if not in the
      label
    - time_s: spacecraft clock at the middle of the exposure; None if not in the label
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
    text = read_label(source)
    label = parse_blocks(text, ("IMAGE", *FRAME_GROUPS), source)
    size = read_size(label, source)
    counts = _read_counts(text, label["IMAGE"], size, source)
    # middle of the exposure: mean of the start and stop counts
    times = [float(match[2]) for match in _CLOCK.finditer(text)]
    time_s = float(np.mean(times)) if times else None
    systems = read_systems(label, source)
    vehicle = next((system.frame for system in systems if system.frame.is_vehicle), None)
    pose = None if vehicle is None else find_pose(vehicle, systems)
    if vehicle is not None and pose is None:
        field = f"{vehicle.name}_COORDINATE_SYSTEM.REFERENCE_COORD_SYSTEM_NAME"
        raise source.error(field, "is a frame without known pose", "SITE_FRAME or MCMF_FRAME")
    return Pds3Product(counts, pose, time_s)


def _read_counts(text: str, image: Any, size: tuple[int, int], source: Source) -> UInt16[np.ndarray, "rows columns"]:
    """Read the image's samples at the label's pointer ^IMAGE. Raises CameraFileError."""
    pointer = POINTER.search(text)
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
    offset = image_offset(pointer, text, source)
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
