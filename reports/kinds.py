"""Deprecated name of the module `marsyard.reports.section_kinds`; accepted until version 0.2."""

from __future__ import annotations

from marsyard.reports.section_kinds import *  # noqa: F403
from marsyard.sim.parameters import warn_deprecated

warn_deprecated("marsyard.reports.kinds", "marsyard.reports.section_kinds")
