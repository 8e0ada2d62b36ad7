"""Tests of flights read from SPICE kernels, which NAIF's library writes for a closed-form motion."""

import shutil
import textwrap
from pathlib import Path

import numpy as np
import pytest
import spiceypy
from scipy.spatial.transform import Rotation

from marsyard.sim.dynamics.pose_files import TrajectoryFileError, read_poses

#: NAIF identifiers of bodies and of frames.
LANDER, SITE, MARS = -999, 399999, 499
CAMERA_FRAME, SITE_FRAME = -999001, 1499901
BEGIN, STEP_S, N_POSES = "2030-01-01T00:00:00", 0.5, 81

LEAPSECONDS = """KPL/LSK
\\begindata
DELTET/DELTA_T_A = 32.184
DELTET/K         = 1.657D-3
DELTET/EB        = 1.671D-2
DELTET/M         = ( 6.239996D0 1.99096871D-7 )
DELTET/DELTA_AT  = ( 36, @2015-JUL-1, 37, @2017-JAN-1 )
"""
#: A clock with 65,536 ticks per second since J2000.
CLOCK = """KPL/SCLK
\\begindata
SCLK_KERNEL_ID           = ( @2030-01-01/12:00:00 )
SCLK_DATA_TYPE_999       = ( 1 )
SCLK01_TIME_SYSTEM_999   = ( 1 )
SCLK01_N_FIELDS_999      = ( 2 )
SCLK01_MODULI_999        = ( 4294967296 65536 )
SCLK01_OFFSETS_999       = ( 0 0 )
SCLK01_OUTPUT_DELIM_999  = ( 1 )
SCLK_PARTITION_START_999 = ( 0.0 )
SCLK_PARTITION_END_999   = ( 2.8147497671065E+14 )
SCLK01_COEFFICIENTS_999  = ( 0.0 0.0 1.0 )
"""
#: The site axes are rotated relative to J2000, so that a missing rotation is detected.
FRAMES = f"""KPL/FK
\\begindata
FRAME_SITE_ENU          = {SITE_FRAME}
FRAME_{SITE_FRAME}_NAME     = 'SITE_ENU'
FRAME_{SITE_FRAME}_CLASS    = 4
FRAME_{SITE_FRAME}_CLASS_ID = {SITE_FRAME}
FRAME_{SITE_FRAME}_CENTER   = {MARS}
TKFRAME_{SITE_FRAME}_RELATIVE = 'J2000'
TKFRAME_{SITE_FRAME}_SPEC     = 'ANGLES'
TKFRAME_{SITE_FRAME}_UNITS    = 'DEGREES'
TKFRAME_{SITE_FRAME}_AXES     = ( 3, 2, 3 )
TKFRAME_{SITE_FRAME}_ANGLES   = ( 20.0, -35.0, 50.0 )
FRAME_LANDER_CAMERA     = {CAMERA_FRAME}
FRAME_{CAMERA_FRAME}_NAME     = 'LANDER_CAMERA'
FRAME_{CAMERA_FRAME}_CLASS    = 3
FRAME_{CAMERA_FRAME}_CLASS_ID = {CAMERA_FRAME}
FRAME_{CAMERA_FRAME}_CENTER   = {LANDER}
CK_{CAMERA_FRAME}_SCLK        = {LANDER}
CK_{CAMERA_FRAME}_SPK         = {LANDER}
"""
FLIGHT_FILE = f"""kernels = ["leap.tls", "lander.tsc", "site.tf", "lander.bsp", "lander.bc"]
target = "{LANDER}"
observer = "{MARS}"
world = "SITE_ENU"
axes = "LANDER_CAMERA"
begin = "{BEGIN}"
end = "2030-01-01T00:00:40"
step_s = {STEP_S}
"""


def compute_flight(times_s: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """Compute positions in site axes, m, shape (n, 3), and the rotations from camera to site axes of a descent."""
    east, north = 20.0 * times_s, -5.0 * times_s + 0.1 * times_s**2
    positions = np.stack([east, north, 2000.0 - 75.0 * times_s + 0.2 * times_s**2], axis=-1)
    turn = Rotation.from_rotvec(np.outer(0.05 * times_s, [0.0, 0.0, 1.0]))
    return positions, Rotation.from_rotvec(np.array([0.3, 0.0, 0.0])) * turn


@pytest.fixture(scope="module")
def kernels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the kernels of the flight and the meta-kernel."""
    folder = tmp_path_factory.mktemp("kernels")
    for name, text in (("leap.tls", LEAPSECONDS), ("lander.tsc", CLOCK), ("site.tf", FRAMES)):
        (folder / name).write_text(text)
    (folder / "flight.spice.toml").write_text(FLIGHT_FILE)
    with spiceypy.KernelPool([str(folder / name) for name in ("leap.tls", "lander.tsc", "site.tf")]):
        begin = spiceypy.str2et(BEGIN)
        times = STEP_S * np.arange(-4, N_POSES + 4)
        positions, attitudes = compute_flight(times)
        rotation = spiceypy.pxform("SITE_ENU", "J2000", begin)
        velocities = np.gradient(positions, times, axis=0)
        # SPICE uses km and km/s.
        states = 1e-3 * np.concatenate([positions @ rotation.T, velocities @ rotation.T], axis=1)
        spk = spiceypy.spkopn(str(folder / "lander.bsp"), "descent", 0)
        span = (begin + times[0], begin + times[-1])
        spiceypy.spkw09(spk, LANDER, MARS, "J2000", *span, "descent", 7, len(times), states.tolist(), begin + times)
        spiceypy.spkcls(spk)
        ticks = [spiceypy.sce2c(LANDER, begin + time) for time in times]
        # C matrices transform vectors from J2000 to camera axes; SPICE quaternions have the scalar first.
        quaternions = [spiceypy.m2q(np.ascontiguousarray((rotation @ turn.as_matrix()).T)) for turn in attitudes]
        ck = spiceypy.ckopn(str(folder / "lander.bc"), "descent", 0)
        rates = np.zeros((len(times), 3))
        tick_span = (ticks[0], ticks[-1])
        spiceypy.ckw03(
            ck, *tick_span, CAMERA_FRAME, "J2000", True, "descent", len(times), ticks, quaternions, rates, 1, [ticks[0]]
        )
        spiceypy.ckcls(ck)
    return folder


def test_kernels_reproduce_the_flight(kernels: Path) -> None:
    kernel_count = spiceypy.ktotal("ALL")
    poses = read_poses(kernels / "flight.spice.toml")
    assert spiceypy.ktotal("ALL") == kernel_count
    assert poses.times_s.size == N_POSES
    np.testing.assert_allclose(poses.times_s, STEP_S * np.arange(N_POSES))
    positions, attitudes = compute_flight(poses.times_s)
    np.testing.assert_allclose(poses.positions_m, positions, atol=1e-6)
    assert (attitudes.inv() * Rotation.from_quat(poses.quaternions)).magnitude().max() < 1e-8


#: A meta-kernel in the folder mk; a path is continued in the next string.
META_KERNEL = """KPL/MK
\\begindata
PATH_SYMBOLS    = ( 'K', 'KERNELS' )
PATH_VALUES     = ( '{first}', '{second}' )
KERNELS_TO_LOAD = ( '$KERNELS/leap.tls', '$K/lander.tsc', '$KERNELS/+'
                    'site.tf', '$KERNELS/lander.bsp', '$K/lander.bc' )
BODY-999_EXTRA  = ( 1.0 )
"""


@pytest.fixture
def meta_kernel(kernels: Path, tmp_path: Path) -> Path:
    """Return a file whose only kernel is a meta-kernel, with paths relative to the meta-kernel."""
    for folder in ("mk", "a", "b"):
        (tmp_path / folder).mkdir()
    for name in ("leap.tls", "lander.tsc", "site.tf", "lander.bsp", "lander.bc"):
        shutil.copy(kernels / name, tmp_path / ("a" if name in ("lander.tsc", "lander.bc") else "b"))
    (tmp_path / "mk" / "flight.tm").write_text(META_KERNEL.format(first="../a", second="../b"))
    kernel_list = FLIGHT_FILE.partition("\n")[0]
    path = tmp_path / "flight.spice.toml"
    path.write_text(FLIGHT_FILE.replace(kernel_list, 'kernels = ["mk/flight.tm"]'))
    return path


@pytest.mark.parametrize("folder", [".", "mk", "/"])
def test_meta_kernels_are_read_from_any_folder(
    kernels: Path, meta_kernel: Path, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    monkeypatch.chdir(meta_kernel.parent / folder)
    poses, expected = read_poses(meta_kernel), read_poses(kernels / "flight.spice.toml")
    np.testing.assert_array_equal(poses.positions_m, expected.positions_m)
    np.testing.assert_array_equal(poses.quaternions, expected.quaternions)


@pytest.mark.parametrize("values", [("a", "b"), ("{folder}/a", "{folder}/b")])
def test_paths_in_meta_kernels_may_be_absolute_or_relative(meta_kernel: Path, values: tuple[str, str]) -> None:
    # strings of text kernels have at most 80 characters; a plus sign continues a string
    folder = meta_kernel.parent.as_posix()
    first, second = (value.format(folder="+'\n'".join(textwrap.wrap(folder, 50))) for value in values)
    (meta_kernel.parent / "mk" / "flight.tm").write_text(META_KERNEL.format(first=first, second=second))
    assert read_poses(meta_kernel).times_s.size == N_POSES


@pytest.mark.parametrize("changed", ["mk/flight.tm", "b/site.tf", "a/lander.bc"])
def test_hash_covers_kernels_in_meta_kernels(meta_kernel: Path, tmp_path: Path, changed: str) -> None:
    copy = tmp_path / "copy"
    copy.mkdir()
    for name in ("mk", "a", "b"):
        shutil.copytree(meta_kernel.parent / name, copy / name)
    path = copy / meta_kernel.name
    shutil.copy(meta_kernel, path)
    assert read_poses(path).sha256 == read_poses(meta_kernel).sha256
    with (copy / changed).open("ab") as file:
        file.write(b"\n")
    other = copy / "other.spice.toml"
    shutil.copy(path, other)
    assert read_poses(other).sha256 != read_poses(meta_kernel).sha256


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("lander.bc", "absent.bc", r"flight.tm: names the kernel \$K/absent.bc, but .*mk/../a/absent.bc .* not exist"),
        ("'K', 'KERNELS'", "'KERNELS'", "has 1 PATH_SYMBOLS and 2 PATH_VALUES"),
        ("$K/lander.bc", "flight.tm", "names the meta-kernel flight.tm"),
        ("KERNELS_TO_LOAD =", "KERNELS_TO_LOAD", "SPICE: "),
    ],
)
def test_faulty_meta_kernels_are_reported(meta_kernel: Path, old: str, new: str, message: str) -> None:
    path = meta_kernel.parent / "mk" / "flight.tm"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    count = spiceypy.ktotal("ALL")
    with pytest.raises(TrajectoryFileError, match=f"flight.spice.toml: .*{message}"):
        read_poses(meta_kernel)
    assert spiceypy.ktotal("ALL") == count


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"leap.tls", ', '"missing.tls", ', "the kernel .*missing.tls does not exist"),
        ('"leap.tls", ', "", "SPICE: .*"),
        ('target = "-999"', 'target = "-998"', "SPICE: .*-998"),
        ('world = "SITE_ENU"', 'world = "SITE_NED"', "SPICE: .*SITE_NED"),
        ("00:00:40", "00:10:00", "SPICE: "),
        ("00:00:40", "00:00:00", "result in 1 poses; allowed: 4 to"),
        ('begin = "2030-01-01T00:00:00"', 'begin = "yesterday"', "SPICE: .*UNPARSEDTIME"),
        ("step_s = 0.5", "step_s = -1.0", "step_s: .*greater than 0"),
        ('world = "SITE_ENU"', 'word = "SITE_ENU"', "world: Field required"),
        ('world = "SITE_ENU"', "world = SITE", "Invalid value"),
    ],
)
def test_kernel_errors_are_reported(kernels: Path, tmp_path: Path, old: str, new: str, message: str) -> None:
    copy = tmp_path / "kernels"
    shutil.copytree(kernels, copy)
    path = copy / "flight.spice.toml"
    path.write_text(FLIGHT_FILE.replace(old, new))
    with pytest.raises(TrajectoryFileError, match=f"flight.spice.toml: .*{message}") as error_info:
        read_poses(path)
    assert "\n" not in str(error_info.value)
