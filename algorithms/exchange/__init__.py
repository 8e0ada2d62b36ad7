"""Algorithms that are programs of their own: cases as files, answers as JSON (docs/custom-algorithms.md)."""

from marsyard.algorithms.exchange.executable import (
    ExecutableSiteEstimator,
    ExecutableTargetTracker,
    ExecutableVelocityEstimator,
    ExecutableVelocityStream,
)
from marsyard.algorithms.exchange.files import (
    EXCHANGE,
    Pictures,
    read_case,
    read_frame,
    read_mast,
    read_pose,
    read_stop,
    read_target,
    write_case,
    write_frame,
)
from marsyard.algorithms.exchange.process import PREFIXES, Command, ExecutableLimits, parse_command
from marsyard.algorithms.exchange.serving import ProgramDetails

__all__ = ["EXCHANGE", "PREFIXES", "Command", "ExecutableLimits", "ExecutableSiteEstimator", "ExecutableTargetTracker"]
__all__ += ["ExecutableVelocityEstimator", "ExecutableVelocityStream", "Pictures", "ProgramDetails", "parse_command"]
__all__ += ["read_case", "read_frame", "read_mast", "read_pose", "read_stop", "read_target", "write_case"]
__all__ += ["write_frame"]
