"""Algorithms that are programs of their own: cases as files, answers as JSON (docs/own-algorithms.md)."""

from algorithms.exchange.executable import PREFIXES, ExecutableSiteEstimator, ExecutableVelocityEstimator, command_of
from algorithms.exchange.files import EXCHANGE, Pictures, read_case, write_case
from algorithms.exchange.process import Command, ExecutableLimits

__all__ = [
    "EXCHANGE",
    "PREFIXES",
    "Command",
    "ExecutableLimits",
    "ExecutableSiteEstimator",
    "ExecutableVelocityEstimator",
    "Pictures",
    "command_of",
    "read_case",
    "write_case",
]
