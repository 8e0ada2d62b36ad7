"""Real pictures with measured attitudes and altitudes, ingested from a user's folder (docs/real-pictures.md).

`layout` says what such a folder holds, `table` and `picture_files` read it, `ingest` holds it against its task and
writes it down as `store` has it; `consistency` tells how pictures and poses agree, with or without truth.
"""

from scenarios.measured.descent import MeasuredVelocityScenario
from scenarios.measured.landing import MeasuredLandingScenario
from scenarios.measured.matching import MatchingScenario

__all__ = ["MatchingScenario", "MeasuredLandingScenario", "MeasuredVelocityScenario"]
