"""Camera models of the CAHV family, their files and conversions.

`Cahv` is linear, `Cahvor` adds radial distortion, `Cahvore` a wide-angle lens with a moving entrance pupil. All three
are immutable, accept arrays with any leading dimensions and share the interface `CameraModel`. Pixels are (u, v),
column and row, with the centre of the upper left pixel at (0, 0).
"""

from marsyard.sim.camera.base import CameraModel, camera_pose, mount_looking_down
from marsyard.sim.camera.cahvore import Cahvore
from marsyard.sim.camera.calibrations import Calibration, read_calibrations
from marsyard.sim.camera.camera_files import read_camera, read_cameras, read_framed_cameras
from marsyard.sim.camera.file_reading import CameraFileError
from marsyard.sim.camera.jpl_files import BODY_FRAME, HEAD_FRAME, read_cahvor, write_cahvor
from marsyard.sim.camera.label_frames import FramedCamera, LabelFrame
from marsyard.sim.camera.models import Cahv, Cahvor
from marsyard.sim.camera.opencv_models import Residual, from_opencv, from_opencv_fisheye
from marsyard.sim.camera.pds3 import Pds3Product, read_pds3_product

__all__ = [
    "BODY_FRAME", "HEAD_FRAME", "Cahv", "Cahvor", "Cahvore", "Calibration", "CameraFileError", "CameraModel",
    "FramedCamera", "LabelFrame", "Pds3Product", "Residual", "camera_pose", "from_opencv", "from_opencv_fisheye",
    "mount_looking_down", "read_cahvor", "read_calibrations", "read_camera", "read_cameras", "read_framed_cameras",
    "read_pds3_product", "write_cahvor",
]  # fmt: skip
