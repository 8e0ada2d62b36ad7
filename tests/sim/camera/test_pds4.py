"""Tests of PDS4 labels: the camera model of a Mars 2020 navcam and error messages."""

from pathlib import Path

import numpy as np
import pytest

from marsyard.sim.camera import Cahv, Cahvor, Cahvore, CameraFileError, read_camera, read_cameras
from tests.sim.camera.labels import assert_fault

#: From NLF_0629_0722782785_631ECM_N0301344NCAM00427_06_095J01 (NASA PDS, mars2020_navcam_ops_raw): the camera model,
#: derived pointing and fields of view, the subframe and the axes.
LABEL = """<?xml version="1.0" encoding="UTF-8"?>
<Product_Observational
    xmlns="http://pds.nasa.gov/pds4/pds/v1"
    xmlns:geom="http://pds.nasa.gov/pds4/geom/v1"
    xmlns:img="http://pds.nasa.gov/pds4/img/v1">
  <Observation_Area><Discipline_Area>
      <geom:Geometry><geom:Geometry_Lander>
          <geom:Camera_Model_Parameters>
            <geom:model_type>CAHVORE</geom:model_type>
            <geom:calibration_source_id>1</geom:calibration_source_id>
            <geom:CAHVORE_Model>
              <geom:Vector_Center>
                <geom:x_position unit="m">0.955584</geom:x_position><geom:y_position unit="m">0.764515</geom:y_position>
                <geom:z_position unit="m">-1.95254</geom:z_position>
              </geom:Vector_Center>
              <geom:Vector_Axis>
                <geom:x_unit>-0.35631</geom:x_unit> <geom:y_unit>0.916392</geom:y_unit>
                <geom:z_unit>0.182443</geom:z_unit>
              </geom:Vector_Axis>
              <geom:Vector_Horizontal>
                <geom:x_pixel>-3229.43</geom:x_pixel> <geom:y_pixel>141.993</geom:y_pixel>
                <geom:z_pixel>229.563</geom:z_pixel>
              </geom:Vector_Horizontal>
              <geom:Vector_Vertical>
                <geom:x_pixel>-168.067</geom:x_pixel> <geom:y_pixel>400.716</geom:y_pixel>
                <geom:z_pixel>3088.89</geom:z_pixel>
              </geom:Vector_Vertical>
              <geom:Vector_Optical>
                <geom:x_unit>-0.357624</geom:x_unit> <geom:y_unit>0.915861</geom:y_unit>
                <geom:z_unit>0.182539</geom:z_unit>
              </geom:Vector_Optical>
              <geom:Radial_Terms>
                <geom:c0>1.736e-06</geom:c0> <geom:c1>0.0501396</geom:c1> <geom:c2>-0.0171254</geom:c2>
              </geom:Radial_Terms>
              <geom:Entrance_Terms>
                <geom:c0>-8.0e-09</geom:c0> <geom:c1>1.0e-08</geom:c1> <geom:c2>-2.9e-08</geom:c2>
              </geom:Entrance_Terms>
              <geom:cahvore_model_type>2</geom:cahvore_model_type>
              <geom:cahvore_model_parameter>0.0</geom:cahvore_model_parameter>
            </geom:CAHVORE_Model>
          </geom:Camera_Model_Parameters>
      </geom:Geometry_Lander></geom:Geometry>
      <img:Imaging>
        <img:Downsampling>
          <img:Pixel_Averaging_Dimensions>
            <img:height_pixels unit="pixel">1</img:height_pixels>
            <img:width_pixels unit="pixel">1</img:width_pixels>
          </img:Pixel_Averaging_Dimensions>
        </img:Downsampling>
        <img:Subframe>
          <img:first_line>953</img:first_line>
          <img:first_sample>1273</img:first_sample>
          <img:lines>976</img:lines>
          <img:samples>1296</img:samples>
          <img:line_fov unit="deg">18.6047</img:line_fov>
          <img:sample_fov unit="deg">24.7326</img:sample_fov>
        </img:Subframe>
      </img:Imaging>
  </Discipline_Area></Observation_Area>
  <File_Area_Observational>
    <Array_3D_Image>
      <axes>3</axes>
      <Axis_Array><axis_name>Band</axis_name><elements>3</elements></Axis_Array>
      <Axis_Array><axis_name>Line</axis_name><elements>976</elements></Axis_Array>
      <Axis_Array><axis_name>Sample</axis_name><elements>1296</elements></Axis_Array>
    </Array_3D_Image>
  </File_Area_Observational>
</Product_Observational>
"""
#: The label without a subframe: first line and sample are 1.
FULL_FRAME = LABEL.replace(">953<", ">1<").replace(">1273<", ">1<")


def write_label(folder: Path, text: str) -> Path:
    path = folder / "label.xml"
    path.write_text(text, encoding="utf-8")
    return path


def test_mars_2020_navcam_is_read(tmp_path: Path) -> None:
    camera = read_camera(write_label(tmp_path, LABEL), subframe_folded_in=True)
    assert isinstance(camera, Cahvore)
    assert camera.size == (1296, 976)
    assert camera.linearity == 0.0
    assert np.array_equal(camera.c, [0.955584, 0.764515, -1.95254])
    assert np.array_equal(camera.h, [-3229.43, 141.993, 229.563])
    assert np.array_equal(camera.r, [1.736e-06, 0.0501396, -0.0171254])
    assert np.array_equal(camera.e, [-8.0e-09, 1.0e-08, -2.9e-08])
    # The label contains the field of view of the subframe. Its definition differs from this one by up to 2 %.
    middle = np.array([647.5, 487.5])
    for edges, fov_deg in (([[-0.5, 487.5], [1295.5, 487.5]], 24.7326), ([[647.5, -0.5], [647.5, 975.5]], 18.6047)):
        first, last = camera.rays(np.array(edges))[1]
        assert np.degrees(np.arccos(first @ last)) == pytest.approx(fov_deg, rel=0.02)
    assert np.all(np.isfinite(camera.rays(middle)[1]))
    # The model refers to the subframe. With the subframe's offset (first sample and line minus 1), the image centre is
    # near the centre of the 5120 x 3840 detector.
    hc, vc = camera.image_centre
    assert hc + 1272 == pytest.approx(2560, rel=0.02)
    assert vc + 952 == pytest.approx(1920, rel=0.02)


def test_subframes_require_subframe_folded_in(tmp_path: Path) -> None:
    with pytest.raises(CameraFileError, match=r"Subframe.first_line: 953.*subframe_folded_in = true"):
        read_cameras(write_label(tmp_path, LABEL))
    binned = FULL_FRAME.replace('<img:height_pixels unit="pixel">1', '<img:height_pixels unit="pixel">2')
    with pytest.raises(CameraFileError, match=r"Downsampling.height_pixels: 2"):
        read_cameras(write_label(tmp_path, binned))
    assert read_cameras(write_label(tmp_path, FULL_FRAME))[0].size == (1296, 976)


def test_namespace_prefixes_are_ignored(tmp_path: Path) -> None:
    other_prefix = FULL_FRAME.replace("geom:", "g:").replace("xmlns:g:", "xmlns:g").replace('xmlns:geom="', 'xmlns:g="')
    assert read_camera(write_label(tmp_path, other_prefix)) == read_camera(write_label(tmp_path, FULL_FRAME))


def test_cahvor_and_cahv_are_read(tmp_path: Path) -> None:
    for name, kind in (("CAHVOR", Cahvor), ("CAHV", Cahv)):
        text = FULL_FRAME.replace(">CAHVORE<", f">{name}<").replace("CAHVORE_Model", f"{name}_Model")
        camera = read_camera(write_label(tmp_path, text))
        assert isinstance(camera, kind)
        assert np.array_equal(camera.v, [-168.067, 400.716, 3088.89])


#: Text of the label that is replaced, its replacement, and the expected message.
FAULTS = [
    ("geom:Camera_Model_Parameters", "geom:Other", "Camera_Model_Parameters: missing"),
    (">CAHVORE<", ">PSPH<", "model_type: 'PSPH'; allowed: CAHV, CAHVOR, CAHVORE"),
    ("geom:CAHVORE_Model", "geom:CAHVOR_Model", "CAHVORE_Model: missing"),
    ("<geom:y_pixel>141.993</geom:y_pixel>", "", r"Vector_Horizontal \(H\).y_pixel: missing"),
    ("141.993", "N/A", r"y_pixel: 'N/A' is not a number"),
    ("141.993", "NaN", "h must be finite"),
    ('unit="m">0.955584', 'unit="mm">0.955584', "x_position: is in 'mm'; allowed: metres"),
    ("geom:Entrance_Terms", "geom:Entrance", r"Entrance_Terms \(E\): missing"),
    ("<geom:cahvore_model_type>2", "<geom:cahvore_model_type>4", "CAHVORE's type is 4"),
    ("0.916392", "0.816392", "A: a must be a unit vector"),
    ("<axis_name>Line<", "<axis_name>Row<", "Axis_Array: names .*Sample.*allowed: the axes Line and Sample"),
    ("<elements>976<", "<elements>-976<", "elements: '-976'; allowed: a positive integer"),
    ("Array_3D_Image", "Array_3D", "Array_2D_Image: missing"),
    ("</Product_Observational>", "", "cannot be parsed"),
    ("<Product_Observational", '<!DOCTYPE p [<!ENTITY a "b">]><Product_Observational', "declares entities"),
]


@pytest.mark.parametrize(("old", "new", "fault"), FAULTS, ids=[f"{old!r} {new!r}" for old, new, _ in FAULTS])
def test_errors_name_field_and_allowed_values(tmp_path: Path, old: str, new: str, fault: str) -> None:
    assert_fault(tmp_path / "label.xml", FULL_FRAME, (old, new), fault)
