"""Task of the target trackers: names of the algorithms, their options, and how they are created."""

from dataclasses import replace

from marsyard.algorithms.exchange import ExecutableTargetTracker
from marsyard.algorithms.interface import MastAim, PixelBox, TargetLoss, TargetTracker, TargetUpdate, TrackingState
from marsyard.algorithms.vtt import PURE_NCC, VisualTargetTracker, VttOptions, lucas_kanade_tracker
from marsyard.algorithms.vtt.options import IMPROVEMENTS
from marsyard.scenarios.tasks import Task, variants

TRACKING: Task[TargetTracker, VttOptions] = Task(
    name="tracking",
    noun="target tracker",
    methods=("designate", "aim", "update", "clear", "state"),
    answers=(MastAim, PixelBox, TargetUpdate, TargetLoss, TrackingState),
    shipped={
        **variants("vtt", VisualTargetTracker, IMPROVEMENTS),
        # the paper's baseline: without scale and roll
        "pure-ncc": lambda options: VisualTargetTracker(
            replace(options, scale=PURE_NCC.scale, roll=PURE_NCC.roll, warp=PURE_NCC.warp)
        ),
        "lucas-kanade": lambda options: lucas_kanade_tracker(replace(options, **IMPROVEMENTS)),
    },
    executable=ExecutableTargetTracker,
    options=VttOptions,
)
