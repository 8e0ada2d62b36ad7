"""What faults of all systems have in common: each is named and has a size, 0 for none; what ails a detector."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

from pydantic import BaseModel, Field

from marsyard.sim.parameters import Parameters
from marsyard.sim.sensor import DetectorParameters

Size = Annotated[float, Field(ge=0.0)]


class SizedFaults(Parameters):
    """Faults by name, each with its size. A size of 0 is no fault."""

    @property
    def name_and_size(self) -> tuple[str, float]:
        """The fault and its size; "none" and 0 without one, "several" and NaN where there are more."""
        present = [(name, float(size)) for name, size in self.model_dump().items() if size]
        if len(present) > 1:
            return "several", float("nan")
        return present[0] if present else ("none", 0.0)


def ailing(detector: DetectorParameters, dust_discs: int, defects: Mapping[str, float | bool]) -> DetectorParameters:
    """The detector with so many specks of dust on its lens, and with these of its defects' parameters anew."""
    changes: dict[str, BaseModel] = {}
    if dust_discs:
        changes["optics"] = detector.optics.model_copy(update={"dust_discs": dust_discs})
    if defects:
        changes["defects"] = detector.defects.model_copy(update=dict(defects))
    return detector.model_copy(update=changes)
