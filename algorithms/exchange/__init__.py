"""External programs as algorithms under test: cases as files, answers as JSON (docs/custom-algorithms.md)."""

from marsyard.algorithms.exchange.executable import (
    SITE_REQUESTS,
    VELOCITY_REQUESTS,
    ExecutableAlgorithm,
    ExecutableTargetTracker,
)
from marsyard.algorithms.exchange.files import (
    EXCHANGE_VERSION,
    ImageFormat,
    read_case,
    read_frame,
    read_mast,
    read_pose,
    read_stop,
    read_target,
    write_case,
    write_frame,
)
from marsyard.algorithms.exchange.forms import SITE_FORM, VELOCITY_FORM, AnswerForm, ProgramDetails, answer_time_s
from marsyard.algorithms.exchange.limits import ExecutableLimits
from marsyard.algorithms.exchange.serving import PREFIXES, Command, parse_command
from marsyard.algorithms.exchange.streams import VELOCITY_STREAM, StreamForm

__all__ = [
    "EXCHANGE_VERSION", "PREFIXES", "SITE_FORM", "SITE_REQUESTS", "VELOCITY_FORM", "VELOCITY_REQUESTS",
    "VELOCITY_STREAM", "AnswerForm", "Command", "ExecutableAlgorithm", "ExecutableLimits", "ExecutableTargetTracker",
    "ImageFormat", "ProgramDetails", "StreamForm", "answer_time_s", "parse_command", "read_case", "read_frame",
    "read_mast", "read_pose", "read_stop", "read_target", "write_case", "write_frame",
]  # fmt: skip
