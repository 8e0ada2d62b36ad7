"""PDS3 products: the picture itself, behind its label or in a file next to it, and the pose that the label states."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera.assembly import Source
from marsyard.sim.camera.pds_labels import label_text, parsed_blocks, picture_size
from marsyard.sim.files import check_regular
from marsyard.sim.frames import rigid

#: The rover's pose; the second is Curiosity's.
_ROVERS = ("ROVER_COORDINATE_SYSTEM", "ROVER_COORDINATE_SYSTEM_PARMS")
#: `9`, `20481 <BYTES>`, `("PICTURE.IMG", 9)`, `("PICTURE.IMG", 20481 <BYTES>)`, `"PICTURE.IMG"`.
_POINTER = re.compile(
    r"^[ \t]*\^IMAGE[ \t]*=[ \t]*"
    r"(?:\([ \t]*\"(?P<detached>[^\"\n]+)\"[ \t]*,[ \t]*(?P<at>\d+)[ \t]*(?P<at_bytes><BYTES>)?[ \t]*\)"
    r"|\"(?P<alone>[^\"\n]+)\"|(?P<place>\d+)[ \t]*(?P<bytes><BYTES>)?)[ \t]*\r?$",
    re.MULTILINE,
)
_RECORD = re.compile(r"^[ \t]*RECORD_BYTES[ \t]*=[ \t]*(\d+)", re.MULTILINE)
_CLOCK = re.compile(r"^[ \t]*SPACECRAFT_CLOCK_(START|STOP)_COUNT[ \t]*=[ \t]*\"?(\d+\.?\d*)\"?[ \t]*\r?$", re.MULTILINE)
#: Samples of whole numbers by the first words of SAMPLE_TYPE; those of 8 bits have no order.
_ORDERS = {"MSB": ">", "LSB": "<", "PC": "<", "SUN": ">", "UNSIGNED": ">", "INTEGER": ">"}
_UNIT = 1e-3


@dataclass(frozen=True)
class Pds3Product:
    """A picture with what its label says of when and where it was taken.

    Attributes
    ----------
    counts
        As stored, shape (rows, columns).
    site_from_rover
        The rover's pose in the site frame (x north, y east, z down), metres; None where the label states none.
    time_s
        Spacecraft clock at the middle of the exposure, seconds; None where the label states none.
    """

    counts: UInt16[np.ndarray, "rows columns"]
    site_from_rover: RigidTransform | None
    time_s: float | None


def read_pds3_product(path: str | Path) -> Pds3Product:
    """Reads a picture of whole numbers of 8 or 16 bits, and its pose. `read_pds3` reads its camera.

    Raises
    ------
    CameraFileError
        If the label or the file of the picture cannot be read, the picture is of another kind, or is cut short, or the
        rover's pose is none; it names file, field and what is allowed.
    """
    source = Source(str(path))
    text = label_text(source)
    label = parsed_blocks(text, ("IMAGE", *_ROVERS), source)
    size = picture_size(label, source)
    counts = _counts(label["IMAGE"], size, _place(text, source), source)
    times = [float(found[2]) for found in _CLOCK.finditer(text)]
    rover = next((name for name in _ROVERS if name in label), None)
    return Pds3Product(
        counts=counts,
        site_from_rover=None if rover is None else _pose(label[rover], rover, source),
        time_s=float(np.mean(times)) if times else None,
    )


def _place(text: str, source: Source) -> tuple[Path, int]:
    """The file that holds the picture, the label's own or one next to it, and the bytes before the picture."""
    pointer = _POINTER.search(text)
    if pointer is None:
        raise source.error("^IMAGE", "missing, or of another form", 'a record, bytes, or ("FILE", record)')
    name = pointer["detached"] or pointer["alone"]
    path = Path(source.path) if name is None else _beside(name, source)
    place = int(pointer["at"] or pointer["place"] or 1)
    if place == 1 or pointer["at_bytes"] or pointer["bytes"]:
        return path, place - 1
    record = _RECORD.search(text)
    if record is None:
        raise source.error("RECORD_BYTES", "missing", "the bytes of a record")
    return path, (place - 1) * int(record[1])


def _beside(name: str, source: Source) -> Path:
    """A file in the label's folder; archives differ in the case of names."""
    folder = Path(source.path).parent
    if Path(name).name != name:
        raise source.error("^IMAGE", f"names {name!r}, a file elsewhere", "a file next to the label")
    named = [folder / name, folder / name.lower(), folder / name.upper()]
    return next((path for path in named if path.exists()), named[0])


def _counts(
    image: Any, size: tuple[int, int], place: tuple[Path, int], source: Source
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
    path, offset = place
    wanted = columns * rows * sample.itemsize
    try:
        # what is not there is not asked for: a label may state any size
        there = max(min(check_regular(path).st_size - offset, wanted), 0)
        with path.open("rb") as file:
            file.seek(offset)
            data = file.read(there)
    except OSError as fault:
        raise source.error("^IMAGE", f"{path} cannot be read ({fault.strerror})", "the picture's file") from fault
    if len(data) < wanted:
        raise source.error("IMAGE", f"ends after {len(data)} bytes", f"{columns} x {rows} samples of {bits} bits")
    counts = np.frombuffer(data, dtype=sample).reshape(rows, columns)
    if signed and counts.min() < 0:
        raise source.error("IMAGE", f"holds counts down to {counts.min()}", "counts from 0")
    return counts.astype(np.uint16)


def _pose(group: Any, name: str, source: Source) -> RigidTransform:
    """The rover's pose in its site, from the group's offset and quaternion (scalar first)."""
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
