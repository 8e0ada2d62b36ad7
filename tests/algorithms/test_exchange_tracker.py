"""Tests of external programs as trackers: answers, separate and shared processes, and faults."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.answers import check_aim, check_update
from marsyard.algorithms.exchange import (
    ExecutableLimits,
    ExecutableTargetTracker,
    parse_command,
    read_mast,
    read_stop,
    read_target,
)
from marsyard.algorithms.exchange.files import write_mast, write_stop
from marsyard.algorithms.exchange.serving import end_idle_programs
from marsyard.algorithms.exchange.values import encode
from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.algorithms.interface import MastAim, PixelBox, TargetLoss, TargetTracker, TargetUpdate, TrackingState
from marsyard.algorithms.vtt import VisualTargetTracker, VttOptions
from marsyard.scenarios.conformance import trackers
from marsyard.sim.measurements import PixelTarget, RoverTarget, SiteTarget, TargetDesignation

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "target_tracker.py"

#: A program that serves Marsyard's tracker by the exchange format.
SERVER = """
import json, sys
from pathlib import Path
from marsyard.algorithms.exchange import read_mast, read_pose, read_stop, read_target
from marsyard.algorithms.vtt import VisualTargetTracker, VttOptions
tracker, masts = VisualTargetTracker(VttOptions()), {}
def mast(request):
    return masts.setdefault(request["mast"], read_mast(Path(request["mast"])))
def encode_box(box):
    return {"corner": box.corner, "size": box.size}
print(json.dumps({"exchange": 3, "ready": True}), flush=True)
for line in sys.stdin:
    request = json.loads(line)
    if request["do"] == "designate":
        tracker.designate(read_target(request["target"]), read_pose(request["world_from_rover"]))
        answer = {"state": tracker.state.name}
    elif request["do"] == "clear":
        tracker.clear()
        answer = {"state": tracker.state.name}
    elif request["do"] == "aim":
        aim = tracker.aim(read_pose(request["world_from_rover"]), mast(request))
        answer = {"aim": aim and {"azimuth_rad": aim.azimuth_rad, "elevation_rad": aim.elevation_rad,
                                  "left": encode_box(aim.left), "right": encode_box(aim.right)}}
    else:
        update = tracker.update(read_stop(Path(request["stop"]), mast(request)))
        position = update.position_rover
        answer = {"state": update.state.name, "losses": [loss.name for loss in update.losses],
                  "position_rover": None if position is None else position.tolist()}
    print(json.dumps({"exchange": 3, "id": request["id"], **answer}), flush=True)
"""


def make_tracker(spec: str, time_s: float = 60.0) -> ExecutableTargetTracker:
    command = parse_command(spec)
    assert command is not None
    return ExecutableTargetTracker(command, ExecutableLimits(time_s=time_s))


def write_server(folder: Path, text: str = SERVER) -> str:
    """Write a Python program and return its command line."""
    path = folder / "tracker.py"
    path.write_text(text)
    return f"{sys.executable} {path}"


@pytest.fixture
def import_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make Marsyard's packages importable in programs."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))


@pytest.mark.usefixtures("import_path")
def test_program_matches_python_tracker(tmp_path: Path) -> None:
    python_tracker = VisualTargetTracker(VttOptions())
    reference = trackers.drive_to_target(python_tracker)
    program = make_tracker(f"serve:{write_server(tmp_path)}")
    actual = trackers.drive_to_target(program)
    assert [update.state for update in actual] == [TrackingState.NORMAL] * len(reference)
    for expected_update, update in zip(reference, actual, strict=True):
        assert expected_update.position_rover is not None
        assert update.position_rover is not None
        # Numbers are exchanged exactly; quaternions are normalised again.
        np.testing.assert_allclose(update.position_rover, expected_update.position_rover, rtol=0.0, atol=1e-12)
    lost, expected = (
        trackers.update_tracker(tracker, trackers.pose(2.0), blank=0) for tracker in (program, python_tracker)
    )
    assert lost.state is program.state is TrackingState.LOST
    assert TargetLoss.LOW_MATCH_SCORE in expected.losses
    assert lost.losses == expected.losses
    program.clear()
    assert cast(TargetTracker, program).state is TrackingState.NO_TARGET
    end_idle_programs()


@pytest.mark.slow
@pytest.mark.usefixtures("import_path")
def test_example_tracks_the_target() -> None:
    updates = trackers.drive_to_target(make_tracker(f"exec:{sys.executable} {EXAMPLE}"))
    assert [update.state for update in updates] == [TrackingState.NORMAL] * 4
    for number, update in enumerate(updates):
        true_position = trackers.pose(0.4 * number).inv().apply(trackers.TARGET_M)
        # Half a pixel of disparity at 8 m with a baseline of 0.2 m is 0.13 m in range and 7 mm laterally.
        assert np.abs(update.position_rover - true_position)[0] < 0.27
        assert np.abs(update.position_rover - true_position)[1:].max() < 0.05


#: Start of a program: imports, and the line that reports that it is ready.
READY = 'import json, sys\nprint(json.dumps({"exchange": 3, "ready": True}), flush=True)\n'
#: A program that prints fixed answers without evaluating the requests.
ANSWERING_PROGRAM = (
    READY
    + """
OK = '{"exchange": 3, "state": "NORMAL"}'
AIM = '{"exchange": 3, "aim": {"azimuth_rad": 0, "elevation_rad": 0, "left": BOX, "right": BOX}}'
WIDE, SMALL = '{"corner": [0, 0], "size": [9999, 64]}', '{"corner": [0, 0], "size": [64, 64]}'
VALID_AIM = AIM.replace("BOX", SMALL)
for answer in ANSWERS:
    identity = '"exchange": 3, "id": %d' % json.loads(sys.stdin.readline())["id"]
    print("hm", file=sys.stderr, flush=True)
    print(answer.replace("BOX", SMALL).replace('"exchange": 3', identity), flush=True)
"""
)


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        ("['{}']", "exchange is None; allowed: 3"),
        ("['{\"exchange\": 3}']", "state is None; allowed: NO_TARGET, NORMAL"),
        # the reported fault depends on how soon the process ends
        ("[]", "its output ended without an answer|it closed its input"),
        ('[OK, \'{"exchange": 3, "aim": 3}\']', "aim is 3; allowed: null"),
        ('[OK, \'{"exchange": 3, "aim": {"azimuth_rad": 0}}\']', "an angle of aim is missing"),
        ("[OK, AIM.replace('BOX', '[0, 0, 1024, 1024]')]", r"left is \[0, 0, 1024, 1024\]; allowed"),
        ("[OK, AIM.replace('_rad\": 0', '_rad\": 9')]", "azimuth_rad is 9.0; allowed"),
        ("[OK, AIM.replace('BOX', WIDE)]", "allowed: whole pixels inside the frame"),
        ('[OK, VALID_AIM, \'{"exchange": 3, "state": "FOUND"}\']', "state is 'FOUND'"),
        ('[OK, VALID_AIM, \'{"exchange": 3, "state": "NORMAL"}\']', "position_rover is None"),
        (
            '[OK, VALID_AIM, \'{"exchange": 3, "state": "LOST", "losses": ["TIRED"]}\']',
            "a loss is 'TIRED'; allowed: LOW_MATCH_SCORE",
        ),
        (
            '[OK, VALID_AIM, \'{"exchange": 3, "state": "NORMAL", "position_rover": [1, 2]}\']',
            r"position_rover is '\[1, 2\]'",
        ),
    ],
)
def test_invalid_answers_are_reported_as_faults(tmp_path: Path, answers: str, message: str) -> None:
    fault = Fault.CRASHED if answers == "[]" else Fault.BAD_ANSWER
    program = write_server(tmp_path, ANSWERING_PROGRAM.replace("ANSWERS", answers))
    with pytest.raises(AlgorithmError, match=message) as error:
        trackers.drive_to_target(make_tracker(f"exec:{program}"))
    assert error.value.fault is fault
    assert error.value.stderr == ("" if fault is Fault.CRASHED else "hm\n")


def test_tracker_inputs_round_trip(tmp_path: Path) -> None:
    mast = trackers.mast()
    write_mast(tmp_path, mast)
    restored_mast = read_mast(tmp_path)
    assert restored_mast.geometry.azimuth_limits_rad == mast.geometry.azimuth_limits_rad
    np.testing.assert_array_equal(restored_mast.geometry.head_m, mast.geometry.head_m)
    for reference, actual in ((mast.left, restored_mast.left), (mast.right, restored_mast.right)):
        np.testing.assert_array_equal(reference.h, actual.h)
        assert reference.size == actual.size
    tracker = VisualTargetTracker(VttOptions())
    tracker.designate(trackers.designation(), trackers.pose(0.0))
    aim = tracker.aim(trackers.pose(0.0), mast)
    assert aim is not None
    rotated_pose = RigidTransform.from_components([1.0, 2.0, 3.0], Rotation.from_rotvec([0.1, -0.2, 0.3]))
    stop = replace(trackers.take_images(aim, trackers.pose(0.0)), world_from_rover=rotated_pose)
    write_stop(tmp_path, stop)
    restored_stop = read_stop(tmp_path, restored_mast)
    np.testing.assert_array_equal(restored_stop.left.counts, stop.left.counts)
    assert (restored_stop.left.corner, restored_stop.right.corner) == (stop.left.corner, stop.right.corner)
    assert (restored_stop.azimuth_rad, restored_stop.elevation_rad) == (stop.azimuth_rad, stop.elevation_rad)
    np.testing.assert_allclose(restored_stop.world_from_rover.as_matrix(), rotated_pose.as_matrix(), atol=1e-15)
    assert "true" not in (tmp_path / "stop.json").read_text()
    for path in ("mast.json", "stop.json"):
        (tmp_path / path).write_text("{}")
    with pytest.raises(ValueError, match=r"mast\.json is not a valid mast file"):
        read_mast(tmp_path)
    with pytest.raises(ValueError, match=r"stop\.json is not a valid stop file"):
        read_stop(tmp_path, mast)


@pytest.mark.parametrize(
    "target",
    [
        PixelTarget(np.array([500.25, 400.5]), 0.1, -0.2),
        RoverTarget(np.array([8.0, 0.1, 0.2])),
        SiteTarget(np.array([1.0, 2.0, -3.0])),
    ],
)
def test_all_three_target_designations_round_trip(target: TargetDesignation) -> None:
    assert encode(read_target(encode(target))) == encode(target)
    assert type(read_target(encode(target))) is type(target)


@pytest.mark.parametrize("losses", [TargetLoss.OUT_OF_VIEW, ("OUT_OF_VIEW",), None])
def test_losses_of_another_type_are_refused(losses: object) -> None:
    update = TargetUpdate(TrackingState.LOST, (), None)
    # the run-time checks of the tests would reject the type at creation
    object.__setattr__(update, "losses", losses)
    with pytest.raises(AlgorithmError, match=r"losses is .*; allowed: a tuple of members of TargetLoss") as error:
        check_update(update)
    assert error.value.fault is Fault.BAD_ANSWER


@pytest.mark.parametrize("corner", [(0, 0, 0), (0,), None, (0.0, 0.0)])
def test_region_with_another_number_of_coordinates_is_refused(corner: object) -> None:
    left, right = PixelBox((0, 0), (64, 64)), PixelBox((0, 0), (64, 64))
    object.__setattr__(left, "corner", corner)
    aim = MastAim(azimuth_rad=0.0, elevation_rad=0.0, left=left, right=right)
    with pytest.raises(AlgorithmError, match=r"left has corner .*; allowed: whole pixels inside the frame") as error:
        check_aim(aim, trackers.mast())
    assert error.value.fault is Fault.BAD_ANSWER
