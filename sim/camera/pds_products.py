"""PDS3 products with an attached label: the picture itself, and the pose that its label states."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt16
from scipy.spatial.transform import RigidTransform, Rotation

from sim.camera.assembly import Source
from sim.camera.pds_labels import label_text, parsed_blocks, picture_size
from sim.frames import rigid

_ROVER = "ROVER_COORDINATE_SYSTEM"
_POINTER = re.compile(r"^\^IMAGE[ \t]*=[ \t]*(\d+)[ \t]*(<BYTES>)?[ \t]*\r?$", re.MULTILINE)
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
        If the label cannot be read, the picture is not in the same file, is of another kind, or is cut short, or the
        rover's pose is none; it names file, field and what is allowed.
    """
    source = Source(str(path))
    text = label_text(source)
    label = parsed_blocks(text, ("IMAGE", _ROVER), source)
    size = picture_size(label, source)
    counts = _counts(label["IMAGE"], size, _offset(text, source), source)
    times = [float(found[2]) for found in _CLOCK.finditer(text)]
    return Pds3Product(
        counts=counts,
        site_from_rover=_pose(label[_ROVER], source) if _ROVER in label else None,
        time_s=float(np.mean(times)) if times else None,
    )


def _offset(text: str, source: Source) -> int:
    """Bytes before the picture."""
    pointer = _POINTER.search(text)
    if pointer is None:
        raise source.error("^IMAGE", "missing, or points to another file", "a product with its picture in one file")
    if pointer[2]:
        return int(pointer[1]) - 1
    record = _RECORD.search(text)
    if record is None:
        raise source.error("RECORD_BYTES", "missing", "the bytes of a record")
    return (int(pointer[1]) - 1) * int(record[1])


def _counts(image: Any, size: tuple[int, int], offset: int, source: Source) -> UInt16[np.ndarray, "rows columns"]:
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
    with Path(source.path).open("rb") as file:
        file.seek(offset)
        data = file.read(columns * rows * sample.itemsize)
    if len(data) < columns * rows * sample.itemsize:
        raise source.error("IMAGE", f"ends after {len(data)} bytes", f"{columns} x {rows} samples of {bits} bits")
    counts = np.frombuffer(data, dtype=sample).reshape(rows, columns)
    if signed and counts.min() < 0:
        raise source.error("IMAGE", f"holds counts down to {counts.min()}", "counts from 0")
    return counts.astype(np.uint16)


def _pose(group: Any, source: Source) -> RigidTransform:
    """The rover's pose in its site, from the group's offset and quaternion (scalar first)."""
    vectors = {}
    for field, length in (("ORIGIN_OFFSET_VECTOR", 3), ("ORIGIN_ROTATION_QUATERNION", 4)):
        value = group.get(field) if isinstance(group, Mapping) else None
        numeric = isinstance(value, list) and all(isinstance(one, int | float) for one in value)
        if not numeric or len(value) != length:  # type: ignore[arg-type]  # a list, as just seen
            raise source.error(f"{_ROVER}.{field}", f"{value!r}", f"{length} numbers")
        vectors[field] = np.array(value, dtype=np.float64)
    scalar_first = vectors["ORIGIN_ROTATION_QUATERNION"]
    if abs(float(np.linalg.norm(scalar_first)) - 1.0) > _UNIT:
        raise source.error(f"{_ROVER}.ORIGIN_ROTATION_QUATERNION", "is not of length 1", "a unit quaternion")
    return rigid(Rotation.from_quat(scalar_first[[1, 2, 3, 0]]), vectors["ORIGIN_OFFSET_VECTOR"])
