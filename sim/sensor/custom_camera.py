"""Custom cameras of a campaign: models of the CAHV family, as values or as a camera file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from marsyard.sim.camera import Cahv, Cahvor, Cahvore, CameraModel, mount_looking_down, read_cameras
from marsyard.sim.parameters import Parameters

Vector = tuple[float, float, float]
#: Keys of a custom camera that is read from a file.
_FILE_KEYS = ("file", "number", "subframe_folded_in", "size")


class CustomCamera(Parameters):
    """A camera of the CAHV family in the body frame: at its origin, looking along -z, columns along +x.

    Defined by ``{ file = "camera.yaml" }`` (any format of `marsyard.sim.camera.read_cameras`) or by the path; the other
    fields are then read from the file. The camera is mounted with A pointing down, independent of its pose in the file.
    """

    file: Annotated[str | None, Field(description="camera file that the model was read from")] = None
    number: Annotated[int, Field(ge=0, description="index of the camera in the file, from 0")] = 0
    subframe_folded_in: Annotated[bool, Field(description="accept PDS labels of subframes")] = False
    model: Annotated[Literal["CAHV", "CAHVOR", "CAHVORE"], Field(description="type of the model, read from the file")]
    columns: Annotated[int, Field(ge=16, le=16384)]
    rows: Annotated[int, Field(ge=16, le=16384)]
    h: Annotated[Vector, Field(description="horizontal image vector, pixels")]
    v: Annotated[Vector, Field(description="vertical image vector, pixels")]
    o: Annotated[Vector | None, Field(description="optical axis, unit vector")] = None
    r: Annotated[Vector | None, Field(description="radial distortion")] = None
    e: Annotated[Vector | None, Field(description="entrance pupil shift coefficients, m")] = None
    linearity: Annotated[float | None, Field(description="parameter of CAHVORE")] = None

    @model_validator(mode="after")
    def _check_camera(self) -> CustomCamera:
        self.camera()
        lens = {"o": "CAHVOR", "r": "CAHVOR", "e": "CAHVORE", "linearity": "CAHVORE"}
        unused = [
            name for name, first in lens.items() if len(self.model) < len(first) and getattr(self, name) is not None
        ]
        if unused:
            raise ValueError(f"{self.model} has no {' and '.join(unused)}")
        return self

    def camera(self) -> CameraModel:
        """Create the camera in the body frame. Raises ValueError if a vector is missing."""
        pinhole = Cahv(np.zeros(3), np.array([0.0, 0.0, -1.0]), np.array(self.h), np.array(self.v), self.size)
        if self.model == "CAHV":
            return pinhole
        if self.o is None or self.r is None:
            raise ValueError(f"{self.model} requires o and r")
        if self.model == "CAHVOR":
            return Cahvor.from_cahv(pinhole, r=np.array(self.r), o=np.array(self.o))
        if self.e is None or self.linearity is None:
            raise ValueError("CAHVORE requires e and linearity")
        r, e, o = (np.array(vector) for vector in (self.r, self.e, self.o))
        return Cahvore.from_cahv(pinhole, r, e, linearity=self.linearity, o=o)

    def input_files(self) -> tuple[str, ...]:
        """Return the file that the camera was read from."""
        return () if self.file is None else (self.file,)

    @property
    def size(self) -> tuple[int, int]:
        """Image size (columns, rows)."""
        return self.columns, self.rows

    @classmethod
    def from_camera(cls, camera: CameraModel, **origin: Any) -> CustomCamera:
        """Create the parameters from a camera with any pose, mounted to look down; `origin`: fields of the file."""
        model = mount_looking_down(camera)
        length = float(np.linalg.norm(model.a))  # A in PDS labels is rounded and not exactly a unit vector
        vectors: dict[str, Any] = {
            letter: tuple((getattr(model, letter) / (length if letter in "hv" else 1.0)).tolist())
            for letter in "hvore"
            if hasattr(model, letter)
        }
        values = {"columns": model.size[0], "rows": model.size[1], "linearity": getattr(model, "linearity", None)}
        # class names equal model names
        return cls.model_validate({"model": type(model).__name__.upper(), **values, **vectors, **origin})


def _resolve_camera(values: object) -> object:
    """Read the camera file if the values contain one; return other values unchanged."""
    if isinstance(values, str | Path):
        values = {"file": str(values)}
    if not isinstance(values, Mapping) or "model" in values or not isinstance(values.get("file"), str | Path):
        return values
    unknown = [name for name in values if name not in _FILE_KEYS]
    if unknown:
        raise ValueError(f"unknown key {unknown[0]} for a camera file; allowed: {', '.join(_FILE_KEYS)}")
    path, number, folded = str(values["file"]), values.get("number", 0), values.get("subframe_folded_in", False)
    if not isinstance(folded, bool):
        raise ValueError(f"{path}: subframe_folded_in is {folded!r}; allowed: true or false")
    size = values.get("size")
    if size is not None and not (isinstance(size, list | tuple) and [type(value) for value in size] == [int, int]):
        raise ValueError(f"{path}: size is {size!r}; allowed: [columns, rows]")
    cameras = read_cameras(path, subframe_folded_in=folded, size=None if size is None else (size[0], size[1]))
    if not (isinstance(number, int) and 0 <= number < len(cameras)):
        raise ValueError(f"{path}: number is {number!r}; allowed: 0 to {len(cameras) - 1}")
    if len(cameras) > 1 and "number" not in values:
        raise ValueError(f"{path}: contains {len(cameras)} cameras; set number, 0 to {len(cameras) - 1}")
    return CustomCamera.from_camera(cameras[number], file=path, number=number, subframe_folded_in=folded)


def _resolve_camera_or_preset(value: object) -> object:
    """Return the name of a preset unchanged; read the camera file if the text has a suffix or a folder."""
    return value if isinstance(value, str) and not Path(value).suffix and "/" not in value else _resolve_camera(value)


#: Custom camera in a campaign; and custom camera or name of a preset.
CustomCameraChoice = Annotated[CustomCamera, BeforeValidator(_resolve_camera)]
NamedOrCustomCamera = Annotated[str | CustomCamera, BeforeValidator(_resolve_camera_or_preset)]
