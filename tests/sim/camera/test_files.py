"""Tests of camera files: PDS3 labels, JPL's CAHVOR text files, round trips and error messages."""

import contextlib
import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic import TypeAdapter

from marsyard.sim.camera import (
    Cahv,
    Cahvor,
    Cahvore,
    CameraFileError,
    CameraModel,
    read_cahvor,
    read_camera,
    read_cameras,
    read_pds3_product,
    write_cahvor,
)
from marsyard.sim.sensor import CustomCamera, CustomCameraChoice
from tests.sim.camera.labels import assert_fault

#: A label in the format of Opportunity's products, with the model of the front hazcam.
LABEL = """PDS_VERSION_ID                    = PDS3
RECORD_TYPE                       = FIXED_LENGTH
^IMAGE                            = 3

OBJECT                            = IMAGE
  LINES                           = 1024
  LINE_SAMPLES                    = 1020
  FIRST_LINE                      = 1
  FIRST_LINE_SAMPLE               = 1
END_OBJECT                        = IMAGE

GROUP                             = GEOMETRIC_CAMERA_MODEL
  MODEL_TYPE                      = CAHVORE
  MODEL_COMPONENT_ID              = (C,A,H,V,O,R,E,T,P)
  MODEL_COMPONENT_UNIT            = (METER,"N/A",PIXEL,PIXEL,"N/A","N/A",
                                     METER,"N/A","N/A")
  MODEL_COMPONENT_1               = (0.609331,-0.041064,-0.233849)
  MODEL_COMPONENT_2               = (0.703447,-0.005161,0.710729)
  MODEL_COMPONENT_3               = (351.362,452.204,353.494)
  MODEL_COMPONENT_4               = (35.8065,-1.75143,682.705)
  MODEL_COMPONENT_5               = (0.704402,-0.006062,0.709775)
  MODEL_COMPONENT_6               = (3e-06,-0.012015,-0.007525)
  MODEL_COMPONENT_7               = (0.001442,0.001522,0.000483)
  MODEL_COMPONENT_8               = 3.0
  MODEL_COMPONENT_9               = 0.37
END_GROUP                         = GEOMETRIC_CAMERA_MODEL

GROUP                             = INSTRUMENT_STATE_PARMS
  PIXEL_AVERAGING_HEIGHT          = 1
  PIXEL_AVERAGING_WIDTH           = 1
END_GROUP                         = INSTRUMENT_STATE_PARMS
END
"""

#: The text format of JPL's camera library cmod, with comment, covariances and derived lines.
CMOD_TEXT = """# navcam, left
#

Model = CAHVOR = perspective, distortion

Dimensions = 1024 1024

C =      0.442604     -0.061164     -1.251060
A =      0.939950     -0.338133      0.046498
H =    884.720000    981.763000     24.147200
V =    418.579000   -152.039000   1245.750000
O =      0.946551     -0.315595      0.066642
R =      0.000960     -0.002183      0.018547

S =
  0.0000000e+00  1.0000000e-09 -1.0000000e-09
  0.0000000e+00  1.0000000e-09 -1.0000000e-09

Hs    =   1223.282116
Hc    =    500.747897
Vs    =   1223.694971
Vc    =    502.776496
Theta =     -1.571213 (-90.023899 deg)

S internal =
  0.0000000e+00  1.0000000e-09
"""


def write_file(folder: Path, text: str, name: str = "camera.cahvor") -> Path:
    path = folder / name
    path.write_bytes(text.encode("latin-1"))
    return path


# ----- PDS3 labels -----


def test_opportunity_labels_are_read(labelled_cameras: dict[str, CameraModel], shared_data: Path) -> None:
    for name, expected in labelled_cameras.items():
        label = shared_data / "mer_opportunity" / name
        assert read_camera(label) == expected
        assert read_cameras(str(label)) == (expected,)


def test_cahvore_label_is_read(tmp_path: Path, hazcam: Cahvore) -> None:
    expected = dataclasses.replace(hazcam, size=(1020, 1024))
    assert read_camera(write_file(tmp_path, LABEL)) == expected
    assert read_camera(write_file(tmp_path, LABEL.replace("\n", "\r\n"))) == expected
    assert (
        read_camera(write_file(tmp_path, "CCSD3ZF0000100000001NJPL3IF0PDS200000001\n/* a label */\n" + LABEL))
        == expected
    )
    assert read_camera(write_file(tmp_path, LABEL + "\0\xff END of nothing" * 1000)) == expected


@pytest.mark.parametrize(("cahvore_type", "linearity"), [("1.0", 1.0), ("2", 0.0), ("3.0", 0.37)])
def test_cahvore_types_set_linearity(tmp_path: Path, cahvore_type: str, linearity: float) -> None:
    text = LABEL.replace("MODEL_COMPONENT_8               = 3.0", f"MODEL_COMPONENT_8 = {cahvore_type}")
    camera = read_camera(write_file(tmp_path, text))
    assert isinstance(camera, Cahvore)
    assert camera.linearity == linearity


def test_components_are_assigned_by_letter(tmp_path: Path, hazcam: Cahvore) -> None:
    text = LABEL.replace("(C,A,H,V,O,R,E,T,P)", "(C,A,V,H,O,R,E,T,P)")
    text = text.replace("_3 ", "_X ").replace("_4 ", "_3 ").replace("_X ", "_4 ")
    assert read_camera(write_file(tmp_path, text)) == dataclasses.replace(hazcam, size=(1020, 1024))


def test_type_and_parameter_need_no_letters(tmp_path: Path, hazcam: Cahvore) -> None:
    """Labels of Mars 2020's landing camera name C to E; type and parameter are the components 8 and 9."""
    expected = dataclasses.replace(hazcam, size=(1020, 1024))
    text = LABEL.replace("(C,A,H,V,O,R,E,T,P)", "(C,A,H,V,O,R,E)")
    assert read_camera(write_file(tmp_path, text)) == expected
    without_parameter = text.replace("  MODEL_COMPONENT_9               = 0.37\n", "")
    fish_eye = without_parameter.replace("MODEL_COMPONENT_8               = 3.0", "MODEL_COMPONENT_8 = 2")
    assert read_camera(write_file(tmp_path, fish_eye)) == dataclasses.replace(expected, linearity=0.0)
    with pytest.raises(CameraFileError, match="type 3 has no parameter"):
        read_camera(write_file(tmp_path, without_parameter))
    with pytest.raises(CameraFileError, match="type is missing"):
        read_camera(write_file(tmp_path, text.replace("MODEL_COMPONENT_8 ", "MODEL_COMPONENT_10 ")))


@pytest.mark.parametrize(
    "rest",
    [b"", b" " * 20, b" " * 20 + b"binary", b"\0\xff\x80", b" \r", b"\r\n\0binary", b"\t\xe9binary"],
    ids=["end of file", "padding", "padding and image", "image", "carriage return", "line break", "tab and image"],
)
def test_the_end_of_the_label_needs_no_line_break(tmp_path: Path, hazcam: Cahvore, rest: bytes) -> None:
    path = tmp_path / "camera.img"
    path.write_bytes(LABEL.rstrip().encode() + rest)
    assert read_camera(path) == dataclasses.replace(hazcam, size=(1020, 1024))


def test_an_image_directly_after_the_end_is_found_by_its_pointer(tmp_path: Path, hazcam: Cahvore) -> None:
    """The first bytes of the image are letters."""
    text = LABEL.rstrip().replace("= 3\n", "= 2\nRECORD_BYTES = 00000\n", 1)
    text = text.replace("00000", f"{len(text):05d}")
    path = tmp_path / "camera.img"
    path.write_bytes(text.encode() + b"letters in place of counts")
    assert read_camera(path) == dataclasses.replace(hazcam, size=(1020, 1024))


def test_end_within_a_text_is_not_the_end(tmp_path: Path, hazcam: Cahvore) -> None:
    text = LABEL.replace("^IMAGE", 'DESCRIPTION = "From START to\nEND of the traverse, an\nEND_OF_FILE."\n^IMAGE')
    assert read_camera(write_file(tmp_path, text)) == dataclasses.replace(hazcam, size=(1020, 1024))


def test_label_with_several_models_needs_a_selection(tmp_path: Path) -> None:
    start, end = LABEL.index("GROUP "), LABEL.index("GROUP                             = INSTRUMENT")
    path = write_file(tmp_path, LABEL[:end] + LABEL[start:])
    cameras = read_cameras(path)
    assert len(cameras) == 2
    assert cameras[0] == cameras[1]
    with pytest.raises(CameraFileError, match="2 of them"):
        read_camera(path)


@pytest.mark.parametrize("value", ["2", "2 <pixel>"])
def test_subframes_require_subframe_folded_in(tmp_path: Path, value: str) -> None:
    """Curiosity's labels have units."""
    for field in ("  FIRST_LINE     ", "  FIRST_LINE_SAMPLE ", "  PIXEL_AVERAGING_HEIGHT", "  PIXEL_AVERAGING_WIDTH"):
        lines = [line[:-1] + value if line.startswith(field) else line for line in LABEL.splitlines()]
        path = write_file(tmp_path, "\n".join(lines) + "\n")
        with pytest.raises(CameraFileError, match=f"{field.strip()}: 2.*subframe_folded_in"):
            read_camera(path)
        assert read_camera(path, subframe_folded_in=True).size == (1020, 1024)


#: Text of the label that is replaced, its replacement, and the expected message.
LABEL_FAULTS = [
    ("= GEOMETRIC_CAMERA_MODEL", "= OTHER_MODEL", "GEOMETRIC_CAMERA_MODEL: missing"),
    ("= CAHVORE\n", "= CAHVORES\n", "MODEL_TYPE: 'CAHVORES'; allowed: CAHV, CAHVOR, CAHVORE"),
    ("  MODEL_TYPE                      = CAHVORE\n", "", "MODEL_TYPE: missing"),
    ("(C,A,H,V,O,R,E,T,P)", "(C,A,H,V,O,R,Q,T,P)", "MODEL_COMPONENT_ID: has no E"),
    ("(C,A,H,V,O,R,E,T,P)", "(C,A,H,V,O,R,E,R,P)", "repeats a letter"),
    ("(C,A,H,V,O,R,E,T,P)", "CAHVORE", "a list of letters"),
    ("(351.362,452.204,353.494)", "(351.362,452.204)", r"MODEL_COMPONENT_3 \(H\): .*three finite numbers"),
    ("(351.362,452.204,353.494)", '(351.362,"N/A",353.494)', r"MODEL_COMPONENT_3 \(H\)"),
    ("(0.703447,-0.005161,0.710729)", "(0.703447,-0.005161,0.810729)", "A: a must be a unit vector"),
    ("(0.703447,-0.005161,0.710729)", "(NaN,-0.005161,0.710729)", "A"),
    ("  MODEL_COMPONENT_6", "  MODEL_COMPONENT_66", r"MODEL_COMPONENT_6 \(R\): missing"),
    ("MODEL_COMPONENT_8               = 3.0", "MODEL_COMPONENT_8 = 4.0", "type is 4.0; allowed: type 1, 2 or 3"),
    ("MODEL_COMPONENT_8               = 3.0", 'MODEL_COMPONENT_8 = "N/A"', r"MODEL_COMPONENT_8 \(T\)"),
    ("MODEL_COMPONENT_9               = 0.37", "MODEL_COMPONENT_9 = 3.7", "LINEARITY: .*between -1 and 1"),
    ("  MODEL_COMPONENT_9               = 0.37\n", "", r"MODEL_COMPONENT_9 \(P\): missing"),
    ("(METER,", "(MM,", "MODEL_COMPONENT_UNIT: 'MM' for C; allowed: METER"),
    ("LINES                           = 1024", 'LINES = "N/A"', "IMAGE.LINES: 'N/A'; allowed: a positive integer"),
    ("  LINE_SAMPLES                    = 1020\n", "", "IMAGE.LINE_SAMPLES: missing"),
    ("LINE_SAMPLES                    = 1020", "LINE_SAMPLES = -4", "IMAGE.LINE_SAMPLES: -4"),
    ("= IMAGE\n", "= PICTURE\n", "IMAGE: missing"),
    ("\nEND\n", "\n", "END: missing"),
    ("END_GROUP                         = GEOMETRIC_CAMERA_MODEL\n", "", "GEOMETRIC_CAMERA_MODEL: .* or not closed"),
]


def test_one_unit_can_be_that_of_all_components(tmp_path: Path) -> None:
    start, _, rest = LABEL.partition('(METER,"N/A"')
    expected = read_camera(write_file(tmp_path, LABEL))
    assert read_camera(write_file(tmp_path, f'{start}"N/A"{rest.partition(")")[2]}')) == expected


@pytest.mark.parametrize(("old", "new", "fault"), LABEL_FAULTS, ids=[f"{new!r}" for _, new, _ in LABEL_FAULTS])
def test_label_errors_name_field_and_allowed_values(tmp_path: Path, old: str, new: str, fault: str) -> None:
    assert_fault(tmp_path / "faulty.IMG", LABEL, (old, new), fault, read_camera)


# ----- JPL text files -----


def test_cmod_text_file_is_read(tmp_path: Path, navcam: Cahvor) -> None:
    camera = read_cahvor(write_file(tmp_path, CMOD_TEXT))
    assert isinstance(camera, Cahvor)
    assert camera.size == (1024, 1024)
    for name in "cahvor":  # The format %13f has six decimals.
        assert np.allclose(getattr(camera, name), getattr(navcam, name), rtol=0, atol=5.1e-7)


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_spacing_and_line_endings_may_differ(tmp_path: Path, ending: str) -> None:
    text = CMOD_TEXT.replace("C =", "  C  =").replace("Dimensions = 1024 1024", "Dimensions=1024\t1024 # columns, rows")
    expected = read_cahvor(write_file(tmp_path, CMOD_TEXT, "plain"))
    assert read_camera(write_file(tmp_path, text.replace("\n", ending))) == expected


@pytest.mark.parametrize(
    ("model", "linearity"),
    [
        ("CAHV = perspective, linear", None),
        ("CAHVORE1 = perspective, distortion, pupil", 1.0),
        ("CAHVORE2 = fish-eye", 0.0),
        ("CAHVORE3,0.37 = general", 0.37),
        ("CAHVORE3, -0.5", -0.5),
    ],
)
def test_models_of_text_files_are_read(tmp_path: Path, model: str, linearity: float | None) -> None:
    text = CMOD_TEXT.replace("CAHVOR = perspective, distortion", model).replace("\nS =", "E = 0.001 0.002 0.003\n\nS =")
    camera = read_camera(write_file(tmp_path, text))
    assert isinstance(camera, Cahv if linearity is None else Cahvore)
    if isinstance(camera, Cahvore):
        assert camera.linearity == linearity
        assert camera.e.tolist() == [0.001, 0.002, 0.003]


def test_written_cameras_round_trip(tmp_path: Path, camera: CameraModel) -> None:
    path = tmp_path / "camera.txt"
    write_cahvor(camera, path, comment="the left one\nModel = NONE", frame="body\nModel = NONE")
    assert read_cahvor(path) == camera
    assert read_camera(path) == camera
    assert path.read_text().startswith("# the left one\n# Model = NONE\n")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    arrays(float, 3, elements=st.floats(-1e12, 1e12)),
    arrays(float, 3, elements=st.floats(-0.9, 1e3)),
    st.floats(-1, 1),
    st.tuples(st.integers(1, 10**6), st.integers(1, 10**6)),
)
def test_round_trip_is_exact(
    tmp_path: Path, hazcam: Cahvore, c: np.ndarray, r: np.ndarray, linearity: float, size: tuple[int, int]
) -> None:
    camera = dataclasses.replace(hazcam, c=c, r=r, linearity=linearity, size=size)
    write_cahvor(camera, tmp_path / "camera.cahvore")
    assert read_camera(tmp_path / "camera.cahvore") == camera


#: Text of the file that is replaced, its replacement, and the expected message.
CMOD_TEXT_FAULTS = [
    ("Model = CAHVOR = perspective, distortion\n", "", "Model: missing"),
    ("Model = CAHVOR =", "Model = CAHVOX =", "Model: 'CAHVOX.*allowed: CAHV, CAHVOR, CAHVORE1"),
    ("Model = CAHVOR =", "Model = CAHVORE =", "type is missing; allowed: type 1, 2 or 3"),
    ("Model = CAHVOR =", "Model = CAHVORE4 =", "type is 4"),
    ("Model = CAHVOR =", "Model = CAHVORE3 =", "Model: CAHVORE of type 3 has no parameter"),
    ("Model = CAHVOR =", "Model = CAHVORE3,wide =", "Model: 'wide' in line 4 is not a number"),
    ("Model = CAHVOR =", "Model = CAHVORE1 =", "E: missing; allowed: a line 'E = ...'"),
    ("Dimensions = 1024 1024\n", "", "Dimensions: missing"),
    ("Dimensions = 1024 1024", "Dimensions = 1024", "Dimensions: '1024' in line 6; allowed: two positive integers"),
    ("Dimensions = 1024 1024", "Dimensions = 1024 0", "Dimensions"),
    ("Dimensions = 1024 1024", "Dimensions = 1024.5 3", "Dimensions"),
    ("884.720000    981.763000     24.147200", "884.720000    981.763000", "H: 2 words in line 10; allowed: three"),
    ("884.720000    981.763000", "884.72O000    981.763000", "H: '884.72O000' in line 10 is not a number"),
    ("884.720000    981.763000", "nan    981.763000", "H: h must be finite"),
    ("     0.939950", "     0.039950", "A: a must be a unit vector"),
    ("O =      0.946551", "O =     -0.946551", "O: "),
    ("R =      0.000960", "R =     -1.000960", "R: r must begin with a number above -1"),
    ("R =  ", "A =  ", "A: defined twice, in lines 9 and 13"),
    ("V =  ", "W =  ", "V: missing"),
]


@pytest.mark.parametrize(("old", "new", "fault"), CMOD_TEXT_FAULTS, ids=[f"{new!r}" for _, new, _ in CMOD_TEXT_FAULTS])
def test_text_errors_name_field_and_allowed_values(tmp_path: Path, old: str, new: str, fault: str) -> None:
    assert_fault(tmp_path / "faulty.cahvor", CMOD_TEXT, (old, new), fault, read_camera)


def test_missing_files_and_unknown_formats_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(CameraFileError, match=r"absent.cahvor: file: cannot be read \(No such file"):
        read_camera(tmp_path / "absent.cahvor")
    with pytest.raises(CameraFileError, match="cannot be read"):
        read_camera(tmp_path)
    with pytest.raises(CameraFileError, match=r"is empty \(0 bytes\)"):
        read_camera(write_file(tmp_path, ""))
    with pytest.raises(CameraFileError, match="PDS_VERSION_ID: missing"):
        read_pds3_product(write_file(tmp_path, CMOD_TEXT))


#: The label with the keywords and group names of a navigation camera of Curiosity (MSL_MMM EDR).
CURIOSITY = (
    LABEL.replace("PDS_VERSION_ID                    = PDS3", "ODL_VERSION_ID                    = ODL3")
    .replace("^IMAGE                            = 3", '^IMAGE                            = ("NLB_0001.IMG", 9)')
    .replace("GEOMETRIC_CAMERA_MODEL", "GEOMETRIC_CAMERA_MODEL_PARMS")
    .replace("  MODEL_TYPE ", '  ^MODEL_DESC                     = "GEOMETRIC_CM.TXT"\n  MODEL_TYPE ')
)


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_curiosity_labels_are_read(tmp_path: Path, ending: str) -> None:
    mer_path, curiosity_path = tmp_path / "opportunity.lbl", tmp_path / "curiosity.lbl"
    mer_path.write_text(LABEL)
    curiosity_path.write_bytes(CURIOSITY.replace("\n", ending).encode())
    (expected,), (result,) = read_cameras(mer_path), read_cameras(curiosity_path)
    assert result == expected


def test_text_files_without_dimensions_use_the_given_size(tmp_path: Path) -> None:
    with_size, without_size = tmp_path / "with_size.cahvor", tmp_path / "without_size.cahvor"
    with_size.write_text(CMOD_TEXT)
    without_size.write_text(CMOD_TEXT.replace("Dimensions = 1024 1024\n", ""))
    with pytest.raises(CameraFileError, match=r"Dimensions: missing; allowed: a line .* or size = \[columns, rows\]"):
        read_cameras(without_size)
    assert read_cameras(without_size, size=(1024, 1024)) == read_cameras(with_size)
    with pytest.raises(CameraFileError, match="Dimensions: 1024 1024; allowed: the given size, 512 512"):
        read_cameras(with_size, size=(512, 512))
    choice: TypeAdapter[CustomCamera] = TypeAdapter(CustomCameraChoice)
    assert choice.validate_python({"file": str(without_size), "size": [1024, 1024]}).size == (1024, 1024)
    with pytest.raises(ValueError, match=r"size is \[1024\]; allowed: \[columns, rows\]"):
        choice.validate_python({"file": str(without_size), "size": [1024]})


@pytest.mark.slow
@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from([CMOD_TEXT, LABEL]), st.integers(0, 1700), st.binary(min_size=0, max_size=12), st.integers(0, 30)
)
def test_damaged_files_raise_file_errors(
    tmp_path: Path, text: str, position: int, insertion: bytes, removed: int
) -> None:
    original = text.encode("latin-1")
    path = tmp_path / "damaged"
    path.write_bytes(original[:position] + insertion + original[position + removed :])
    with contextlib.suppress(CameraFileError):
        assert len(read_cameras(path)) == 1
