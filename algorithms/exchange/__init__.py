"""External programs as algorithms under test: cases as files, answers as JSON (docs/custom-algorithms.md)."""

from marsyard.algorithms.exchange.executable import (
    ExecutableSiteEstimator,
    ExecutableTargetTracker,
    ExecutableVelocityEstimator,
    ExecutableVelocityStream,
)
from marsyard.algorithms.exchange.files import (
    FORMAT_VERSION,
    ImageFormat,
    read_altitude,
    read_case,
    read_frame,
    read_increments,
    read_mast,
    read_pose,
    read_stop,
    read_target,
    write_case,
    write_frame,
)
from marsyard.algorithms.exchange.process import PREFIXES, Command, ExecutableLimits, parse_command
from marsyard.algorithms.exchange.serving import ProgramDetails

__all__ = ["FORMAT_VERSION", "PREFIXES", "Command", "ExecutableLimits", "ExecutableSiteEstimator"]
__all__ += ["ExecutableTargetTracker", "ExecutableVelocityEstimator", "ExecutableVelocityStream", "ImageFormat"]
__all__ += ["ProgramDetails", "parse_command", "read_altitude", "read_case", "read_frame", "read_increments"]
__all__ += ["read_mast", "read_pose", "read_stop", "read_target", "write_case", "write_frame"]
