"""ROS 2 bag of a case (storage MCAP): images, camera calibration, inertial data, true and estimated poses.

=========================== ========================= ======================================================
topic                       type                      contents
=========================== ========================= ======================================================
/camera/NAME/image_raw      sensor_msgs/Image         counts, mono16
/camera/NAME/camera_info    sensor_msgs/CameraInfo    the true camera; distortion model `cahvor` or `cahvore`, D
                                                      as in `marsyard.scenarios.timeline.CameraPose`
/camera/NAME/pose           geometry_msgs/PoseStamped true pose of the optical frame (x right, y down, z forward)
/imu                        sensor_msgs/Imu           measured rates and specific forces, body axes
/pose/NAME                  geometry_msgs/PoseStamped poses of the path NAME: `true`, `estimated`
/tf                         tf2_msgs/TFMessage        true poses of `body` and of the optical frames in `world`
=========================== ========================= ======================================================

Positions are in the frame `world` (east, north, up). Time 0 of the bag is the first time of the case; its time on the
simulation's clock is the custom data `start_s` in `metadata.yaml`.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from marsyard.scenarios.timeline import TimedImage, Timeline

#: Version of the bag's metadata: that of ROS 2 Jazzy.
_BAG_VERSION = 9
_WORLD, _BODY = "world", "body"
#: Distortion models by the number of coefficients.
_MODELS = {0: "plumb_bob", 6: "cahvor", 10: "cahvore"}


def write_ros_bag(directory: Path, timeline: Timeline) -> None:
    """Write a timeline as a ROS 2 bag into a new folder.

    Raises OSError if it cannot be written, and rosbags' WriterError if the folder exists.
    """
    _BagWriter(timeline).write(directory)


class _BagWriter:
    """Messages of a timeline in the order of their times."""

    def __init__(self, timeline: Timeline) -> None:
        self._timeline = timeline
        self._types = get_typestore(Stores.ROS2_JAZZY)
        times = [image.time_s for image in timeline.images]
        times += [float(path.times_s.min()) for path in timeline.paths.values() if path.times_s.size]
        if timeline.inertial is not None:
            times.append(float(timeline.inertial.times_s[0]))
        self._start_s = min(times, default=0.0)

    def write(self, directory: Path) -> None:
        """Write all messages; they are sorted by time."""
        with Writer(directory, version=_BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as bag:
            bag.set_custom_data("start_s", repr(self._start_s))
            connections: dict[str, Any] = {}
            for stamp_ns, topic, message in sorted(self._messages(), key=lambda item: item[:2]):
                if topic not in connections:
                    connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=self._types)
                bag.write(connections[topic], stamp_ns, self._types.serialize_cdr(message, message.__msgtype__))

    def _messages(self) -> Iterator[tuple[int, str, Any]]:
        """Yield time stamp in ns, topic and message."""
        for image in self._timeline.images:
            yield from self._image_messages(image)
        for name, track in self._timeline.paths.items():
            for time_s, position, quaternion in zip(
                track.times_s, track.positions_m, track.quaternions_xyzw, strict=True
            ):
                yield self._pose(f"/pose/{_topic_name(name)}", float(time_s), position, quaternion)
                if name == "true":
                    yield self._transform(_BODY, float(time_s), position, quaternion)
        if self._timeline.inertial is not None:
            data = self._timeline.inertial
            rows = zip(data.times_s, data.rates_rad_s, data.specific_forces_m_s2, strict=True)
            for time_s, rate, force in rows:
                stamp, header = self._header(float(time_s), _BODY)
                unknown = np.array([-1.0, *np.zeros(8)])  # ROS's sign that no attitude is measured
                message = self._type("sensor_msgs/msg/Imu")(
                    header=header,
                    orientation=self._quaternion(np.array([0.0, 0.0, 0.0, 1.0])),
                    orientation_covariance=unknown,
                    angular_velocity=self._type("geometry_msgs/msg/Vector3")(*rate.tolist()),
                    angular_velocity_covariance=np.zeros(9),
                    linear_acceleration=self._type("geometry_msgs/msg/Vector3")(*force.tolist()),
                    linear_acceleration_covariance=np.zeros(9),
                )
                yield stamp, "/imu", message

    def _image_messages(self, image: TimedImage) -> Iterator[tuple[int, str, Any]]:
        """Yield the messages of one image: its counts, its camera and its pose."""
        topic = f"/camera/{_topic_name(image.camera)}"
        stamp, header = self._header(image.time_s, f"{_topic_name(image.camera)}_optical")
        rows, columns = image.counts.shape
        counts = np.ascontiguousarray(image.counts.astype("<u2"))
        yield (
            stamp,
            f"{topic}/image_raw",
            self._type("sensor_msgs/msg/Image")(
                header=header,
                height=rows,
                width=columns,
                encoding="mono16",
                is_bigendian=0,
                step=2 * columns,
                data=counts.view(np.uint8).ravel(),
            ),
        )
        (fx, fy), (cx, cy) = image.pose.focal_px.tolist(), image.pose.centre_px.tolist()
        yield (
            stamp,
            f"{topic}/camera_info",
            self._type("sensor_msgs/msg/CameraInfo")(
                header=header,
                height=rows,
                width=columns,
                distortion_model=_MODELS[image.pose.distortion.size],
                d=np.asarray(image.pose.distortion, dtype=np.float64),
                k=np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
                r=np.eye(3).ravel(),
                p=np.array([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
                binning_x=0,
                binning_y=0,
                roi=self._type("sensor_msgs/msg/RegionOfInterest")(
                    x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
                ),
            ),
        )
        pose = image.time_s, image.pose.position_m, image.pose.quaternion_xyzw
        yield self._pose(f"{topic}/pose", *pose)
        yield self._transform(header.frame_id, *pose)

    def _pose(self, topic: str, time_s: float, position: np.ndarray, quaternion: np.ndarray) -> tuple[int, str, Any]:
        """Return stamp, topic and message of a pose in the world."""
        stamp, header = self._header(time_s, _WORLD)
        pose = self._type("geometry_msgs/msg/Pose")(
            position=self._type("geometry_msgs/msg/Point")(*position.tolist()), orientation=self._quaternion(quaternion)
        )
        return stamp, topic, self._type("geometry_msgs/msg/PoseStamped")(header=header, pose=pose)

    def _transform(
        self, frame: str, time_s: float, position: np.ndarray, quaternion: np.ndarray
    ) -> tuple[int, str, Any]:
        """Return stamp, topic and message of the pose of a frame in the world, as a transform for `/tf`."""
        stamp, header = self._header(time_s, _WORLD)
        transform = self._type("geometry_msgs/msg/Transform")(
            translation=self._type("geometry_msgs/msg/Vector3")(*position.tolist()),
            rotation=self._quaternion(quaternion),
        )
        stamped = self._type("geometry_msgs/msg/TransformStamped")(
            header=header, child_frame_id=frame, transform=transform
        )
        return stamp, "/tf", self._type("tf2_msgs/msg/TFMessage")(transforms=[stamped])

    def _quaternion(self, xyzw: np.ndarray) -> Any:
        return self._type("geometry_msgs/msg/Quaternion")(*xyzw.tolist())

    def _header(self, time_s: float, frame: str) -> tuple[int, Any]:
        """Return the stamp in ns and the header of a message."""
        stamp_ns = round((time_s - self._start_s) * 1e9)
        stamp = self._type("builtin_interfaces/msg/Time")(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        return stamp_ns, self._type("std_msgs/msg/Header")(stamp=stamp, frame_id=frame)

    def _type(self, name: str) -> Any:
        return self._types.types[name]


def _topic_name(name: str) -> str:
    """Convert a name to a part of a topic."""
    return re.sub(r"\W+", "_", name)
