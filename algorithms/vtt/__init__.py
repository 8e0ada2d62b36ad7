"""Visual target tracking while a rover drives to the target (Kim et al., "Targeted Driving Using Visual Tracking")."""

from marsyard.algorithms.vtt.arm import ArmTarget, GoalCriterion, HandOff, HandOffOutcome, hand_off
from marsyard.algorithms.vtt.options import PURE_NCC, VttOptions
from marsyard.algorithms.vtt.tracker import VisualTargetTracker, VttDetails, lucas_kanade_tracker

__all__ = [
    "PURE_NCC", "ArmTarget", "GoalCriterion", "HandOff", "HandOffOutcome", "VisualTargetTracker", "VttDetails",
    "VttOptions", "hand_off", "lucas_kanade_tracker",
]  # fmt: skip
