"""Tests of reading images and poses from PDS3 products of Opportunity and from synthetic products."""

from pathlib import Path

import numpy as np
import pytest

from marsyard.sim.camera import CameraFileError, read_pds3_product
from marsyard.sim.camera.label_frames import SITE

#: Image of the synthetic products, 3 x 4 counts, and their label.
COUNTS = np.arange(12, dtype=np.uint16).reshape(3, 4) * 300
LABEL = """PDS_VERSION_ID = PDS3
RECORD_BYTES = 512
^IMAGE = {pointer}
SPACECRAFT_CLOCK_START_COUNT = "100.25"
SPACECRAFT_CLOCK_STOP_COUNT = "100.75"
OBJECT = IMAGE
  LINES = 3
  LINE_SAMPLES = 4
  SAMPLE_TYPE = {kind}
  SAMPLE_BITS = {bits}
  BANDS = 1
END_OBJECT = IMAGE
GROUP = ROVER_COORDINATE_SYSTEM
  ORIGIN_OFFSET_VECTOR = (1.0, 2.0, 3.0)
  ORIGIN_ROTATION_QUATERNION = {quaternion}
END_GROUP = ROVER_COORDINATE_SYSTEM
END
"""


def write_product(
    folder: Path,
    sample_dtype: str = ">i2",
    pointer: str = "3",
    kind: str = "MSB_INTEGER",
    bits: int = 16,
    quaternion: str = "(0.8, 0.0, 0.0, 0.6)",
    counts: np.ndarray = COUNTS,
) -> Path:
    """Write a product whose image begins at its third record."""
    path = folder / "made.img"
    label = LABEL.format(pointer=pointer, kind=kind, bits=bits, quaternion=quaternion).encode()
    path.write_bytes(label.ljust(1024, b" ") + counts.astype(sample_dtype).tobytes())
    return path


@pytest.mark.parametrize(
    ("sample_dtype", "pointer", "kind", "bits"),
    [
        (">i2", "3", "MSB_INTEGER", 16),
        (">u2", "1025 <BYTES>", "MSB_UNSIGNED_INTEGER", 16),
        ("<i2", "3", "LSB_INTEGER", 16),
        ("u1", "3", "UNSIGNED_INTEGER", 8),
    ],
)
def test_all_sample_types_are_read(tmp_path: Path, sample_dtype: str, pointer: str, kind: str, bits: int) -> None:
    counts = COUNTS // 16 if bits == 8 else COUNTS
    result = read_pds3_product(write_product(tmp_path, sample_dtype, pointer, kind, bits, counts=counts))
    assert np.array_equal(result.counts, counts)
    assert result.time_s == 100.5
    # The quaternion has the scalar first. It is a right turn about the down axis by 2 acos 0.8.
    assert result.pose is not None
    frame, site_from_rover = result.pose
    assert frame.name == SITE
    forward = site_from_rover.rotation.apply(np.array([1.0, 0.0, 0.0]))
    assert np.allclose(forward, [0.8**2 - 0.6**2, 2 * 0.8 * 0.6, 0.0])
    assert np.allclose(site_from_rover.translation, [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pointer": '("other.img", 3)'}, r"\^IMAGE: .*other.img cannot be read \(No such file"),
        ({"kind": "IEEE_REAL"}, "SAMPLE_TYPE, SAMPLE_BITS: IEEE_REAL, 16; allowed: integers of 8 or 16 bits"),
        ({"bits": 32}, "MSB_INTEGER, 32"),
        ({"pointer": "4"}, "ends after 0 bytes; allowed: 4 x 3 samples"),
        ({"counts": np.full((3, 4), -1)}, "contains counts down to -1"),
        ({"quaternion": "(1.0, 1.0, 0.0, 0.0)"}, "is not of length 1"),
        ({"quaternion": "(1.0, 0.0)"}, "4 numbers"),
    ],
)
def test_invalid_products_are_rejected(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    with pytest.raises(CameraFileError, match=message) as error_info:
        read_pds3_product(write_product(tmp_path, **changes))  # type: ignore[arg-type]
    assert "made.img" in str(error_info.value)


def test_truncated_image_is_rejected(tmp_path: Path) -> None:
    path = write_product(tmp_path)
    path.write_bytes(path.read_bytes()[:1030])
    with pytest.raises(CameraFileError, match="IMAGE: ends after 6 bytes"):
        read_pds3_product(path)


@pytest.mark.parametrize(
    ("name", "min_count", "max_count", "mean"),
    [("1F483288473EFFCMUFP1214L0M1.IMG", 5, 4046, 840.053), ("1N491020376ILFCNY9P0706L0M1.IMG", 517, 4029, 1421.71)],
)
def test_opportunity_images_match_label_statistics(
    shared_data: Path, name: str, min_count: int, max_count: int, mean: float
) -> None:
    counts = read_pds3_product(shared_data / "mer_opportunity" / name).counts
    assert (counts.shape, counts.min(), counts.max()) == ((1024, 1024), min_count, max_count)
    assert abs(counts.mean() - mean) < 0.005


@pytest.mark.parametrize(
    ("pointer", "offset_bytes"),
    [
        ('("made_data.IMG", 3)', 1024),
        ('("made_data.IMG", 101 <BYTES>)', 100),
        ('("MADE_DATA.IMG",1)', 0),
        ('"made_data.IMG"', 0),
        ('("made_data.IMG")', 0),
        ("('made_data.IMG')", 0),
        ('( "made_data.IMG" ,\n      3 )', 1024),
        ('\n   ("made_data.IMG",\r\n  101 <bytes>)', 100),
        ('("made_data.IMG", 3) /* the image */', 1024),
    ],
)
def test_images_with_detached_label_are_read(tmp_path: Path, pointer: str, offset_bytes: int) -> None:
    """The label also contains the pose in the group of Curiosity's labels."""
    label = LABEL.replace("PDS_VERSION_ID = PDS3", "ODL_VERSION_ID = ODL3")
    label = label.replace("ROVER_COORDINATE_SYSTEM", "ROVER_COORDINATE_SYSTEM_PARMS")
    path = tmp_path / "made.LBL"
    path.write_text(label.format(pointer=pointer, kind="MSB_INTEGER", bits=16, quaternion="(1.0, 0.0, 0.0, 0.0)"))
    data = tmp_path / ("MADE_DATA.IMG" if "MADE" in pointer else "made_data.IMG")
    data.write_bytes(bytes(offset_bytes) + COUNTS.astype(">i2").tobytes())
    result = read_pds3_product(path)
    assert np.array_equal(result.counts, COUNTS)
    assert result.pose is not None
    assert np.allclose(result.pose[1].translation, [1.0, 2.0, 3.0])
    data.write_bytes(bytes(offset_bytes) + b"cut")
    with pytest.raises(CameraFileError, match="IMAGE: ends after 3 bytes"):
        read_pds3_product(path)
    data.unlink()
    with pytest.raises(CameraFileError, match=r"\^IMAGE: .*cannot be read \(No such file"):
        read_pds3_product(path)


def test_image_in_another_folder_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(CameraFileError, match=r"'\.\./made\.img' is in another folder; allowed: a file next to"):
        read_pds3_product(write_product(tmp_path, pointer='("../made.img", 3)'))
