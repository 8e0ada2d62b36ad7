"""Detector of a campaign: its values, or changes to those of a camera preset or of a datasheet."""

from collections.abc import Mapping
from typing import Annotated

from pydantic import BeforeValidator

from marsyard.sim.parameters import merge_parameters
from marsyard.sim.sensor.datasheets import read_datasheet
from marsyard.sim.sensor.detector import DetectorParameters
from marsyard.sim.sensor.presets import preset


def _resolve_detector(values: object) -> object:
    """Merge values with those of the selected preset or datasheet, if there is one."""
    if isinstance(values, str):
        values = {"file": values} if values.endswith(".toml") else {"preset": values}
    if not isinstance(values, Mapping) or all(values.get(key) is None for key in ("preset", "file")):
        return values
    if set(DetectorParameters.model_fields) <= set(values):  # already resolved: values stored with a campaign
        return values
    if {"preset", "file"} <= set(values):
        raise ValueError("a detector is defined by a preset or by a datasheet file, not both")
    changes = {key: value for key, value in values.items() if key not in ("preset", "file")}
    if "file" in values:
        file = str(values["file"])
        return merge_parameters({**read_datasheet(file).parameters().model_dump(), "file": file}, changes)
    return merge_parameters(preset(str(values["preset"])).detector.model_dump(), changes)


#: Detector parameters of a campaign, defined by values or by changes to a preset or datasheet:
#: ``[parameters.detector]`` with ``preset = "mer-descent-field"`` and, for example, ``temperature_c = 23.0``; or
#: ``file = "sensor.toml"``.
DetectorChoice = Annotated[DetectorParameters, BeforeValidator(_resolve_detector)]
