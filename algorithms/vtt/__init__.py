"""Visual target tracking: the rover drives to what it sees (Kim et al., "Targeted Driving Using Visual Tracking")."""

from algorithms.vtt.details import VttDetails
from algorithms.vtt.handoff import ArmTarget, GoalReached, HandOff, HandOffOutcome, hand_off
from algorithms.vtt.lucas_kanade import lucas_kanade_tracker
from algorithms.vtt.options import PURE_NCC, VttOptions
from algorithms.vtt.tracker import VisualTargetTracker

__all__ = [
    "PURE_NCC",
    "ArmTarget",
    "GoalReached",
    "HandOff",
    "HandOffOutcome",
    "VisualTargetTracker",
    "VttDetails",
    "VttOptions",
    "hand_off",
    "lucas_kanade_tracker",
]
