"""User cameras in campaigns: geometry from a camera file, copied into the campaign's parameters when it is read.

Later changes of the file have no effect; `resume` and `append` report them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from marsyard.sim.camera import Cahv, Cahvor, Cahvore, CameraModel, mount_looking_down, read_cameras
from marsyard.sim.parameters import Parameters

Vector = tuple[float, float, float]
_FILES = ("file", "number", "subframe_folded_in", "size")


class CustomCamera(Parameters):
    """A camera of the CAHV family in the body frame: at its origin, looking along -z, columns along +x.

    Stated as ``{ file = "camera.yaml" }`` (any format of `marsyard.sim.camera.read_cameras`) or the path alone; the
    other fields are then filled in. The camera is mounted so that A looks down, independent of its pose in the file.
    """

    file: Annotated[str | None, Field(description="camera file that the model was read from")] = None
    number: Annotated[int, Field(ge=0, description="which of the file's cameras, from 0")] = 0
    subframe_folded_in: Annotated[bool, Field(description="PDS: a subframe's model is the stored picture's")] = False
    model: Annotated[Literal["CAHV", "CAHVOR", "CAHVORE"], Field(description="filled in from the file")]
    columns: Annotated[int, Field(ge=16, le=16384)]
    rows: Annotated[int, Field(ge=16, le=16384)]
    h: Annotated[Vector, Field(description="horizontal image vector, pixels")]
    v: Annotated[Vector, Field(description="vertical image vector, pixels")]
    o: Annotated[Vector | None, Field(description="optical axis, unit vector")] = None
    r: Annotated[Vector | None, Field(description="radial distortion")] = None
    e: Annotated[Vector | None, Field(description="the pupil's motion, m")] = None
    linearity: Annotated[float | None, Field(description="of CAHVORE")] = None

    @model_validator(mode="after")
    def _check_camera(self) -> CustomCamera:
        self.camera()
        return self

    def camera(self) -> CameraModel:
        """Create the camera in the body frame. Raises ValueError if the model lacks a vector."""
        pinhole = Cahv(np.zeros(3), np.array([0.0, 0.0, -1.0]), np.array(self.h), np.array(self.v), self.size)
        if self.model == "CAHV":
            return pinhole
        if self.o is None or self.r is None:
            raise ValueError(f"{self.model} needs o and r")
        if self.model == "CAHVOR":
            return Cahvor.from_cahv(pinhole, r=np.array(self.r), o=np.array(self.o))
        if self.e is None or self.linearity is None:
            raise ValueError("CAHVORE needs e and linearity")
        r, e, o = (np.array(vector) for vector in (self.r, self.e, self.o))
        return Cahvore.from_cahv(pinhole, r, e, linearity=self.linearity, o=o)

    def input_files(self) -> tuple[str, ...]:
        """The file that the camera was read from."""
        return () if self.file is None else (self.file,)

    @property
    def size(self) -> tuple[int, int]:
        """(columns, rows)."""
        return self.columns, self.rows

    @classmethod
    def of(cls, camera: CameraModel, **origin: Any) -> CustomCamera:
        """Create the parameters of a camera of any pose, mounted to look down."""
        mounted = mount_looking_down(camera)
        length = float(np.linalg.norm(mounted.a))  # labels round A
        vectors: dict[str, Any] = {
            letter: tuple((getattr(mounted, letter) / (length if letter in "hv" else 1.0)).tolist())
            for letter in "hvore"
            if hasattr(mounted, letter)
        }
        values = {"columns": mounted.size[0], "rows": mounted.size[1], "linearity": getattr(mounted, "linearity", None)}
        # the classes' names are the models'
        return cls.model_validate({"model": type(mounted).__name__.upper(), **values, **vectors, **origin})


def _read(stated: object) -> object:
    """Read the camera file if a campaign names one; return other statements unchanged."""
    if isinstance(stated, str | Path):
        stated = {"file": str(stated)}
    if not isinstance(stated, Mapping) or "model" in stated or not isinstance(stated.get("file"), str | Path):
        return stated
    unknown = [name for name in stated if name not in _FILES]
    if unknown:
        raise ValueError(f"a camera file leaves nothing else to state than {', '.join(_FILES)}; given: {unknown[0]}")
    path, number, folded = str(stated["file"]), stated.get("number", 0), stated.get("subframe_folded_in", False)
    size = stated.get("size")
    if size is not None and not (isinstance(size, list | tuple) and [type(one) for one in size] == [int, int]):
        raise ValueError(f"{path}: size is {size!r}; allowed: [columns, rows]")
    cameras = read_cameras(path, subframe_folded_in=bool(folded), size=None if size is None else (size[0], size[1]))
    if not (isinstance(number, int) and 0 <= number < len(cameras)):
        raise ValueError(f"{path}: holds {len(cameras)} cameras; number may be 0 to {len(cameras) - 1}, not {number!r}")
    if len(cameras) > 1 and "number" not in stated:
        raise ValueError(f"{path}: holds {len(cameras)} cameras; choose one with number, 0 to {len(cameras) - 1}")
    return CustomCamera.of(cameras[number], file=path, number=number, subframe_folded_in=bool(folded))


def _named_or_read(stated: object) -> object:
    """Return a preset's name unchanged; read a path, which has a suffix or a folder."""
    return stated if isinstance(stated, str) and not Path(stated).suffix and "/" not in stated else _read(stated)


#: A user camera in a campaign; and a user camera or a preset's name.
CustomCameraChoice = Annotated[CustomCamera, BeforeValidator(_read)]
NamedOrCustomCamera = Annotated[str | CustomCamera, BeforeValidator(_named_or_read)]
