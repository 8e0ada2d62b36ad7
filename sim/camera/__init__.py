"""Camera models of the CAHV family, their files and their conversions.

`Cahv` is linear, `Cahvor` adds radial distortion, `Cahvore` a wide-angle lens with a moving entrance pupil. All three
are immutable, take arrays of any leading dimensions and share the interface `CameraModel`. Pixels are (u, v), column
and row, with the centre of the upper left pixel at (0, 0).
"""

from marsyard.sim.camera.assembly import CameraFileError
from marsyard.sim.camera.base import CameraModel
from marsyard.sim.camera.cahv import Cahv
from marsyard.sim.camera.cahvor import Cahvor
from marsyard.sim.camera.cahvore import Cahvore
from marsyard.sim.camera.calibrations import Calibration, read_calibrations
from marsyard.sim.camera.files import read_camera, read_cameras
from marsyard.sim.camera.mounting import looking_down
from marsyard.sim.camera.opencv import Residual, from_opencv, from_opencv_fisheye
from marsyard.sim.camera.pds4_labels import read_pds4
from marsyard.sim.camera.pds_labels import read_pds3
from marsyard.sim.camera.pds_products import Pds3Product, read_pds3_product
from marsyard.sim.camera.text_files import BODY_FRAME, HEAD_FRAME, read_cahvor, write_cahvor

__all__ = [
    "BODY_FRAME",
    "HEAD_FRAME",
    "Cahv",
    "Cahvor",
    "Cahvore",
    "Calibration",
    "CameraFileError",
    "CameraModel",
    "Pds3Product",
    "Residual",
    "from_opencv",
    "from_opencv_fisheye",
    "looking_down",
    "read_cahvor",
    "read_calibrations",
    "read_camera",
    "read_cameras",
    "read_pds3",
    "read_pds3_product",
    "read_pds4",
    "write_cahvor",
]
