"""Growth of costs with size: ``python -m benchmarks.growth`` draws docs/images/growth.svg.

- Core-seconds of a frame as a function of its number of pixels, and of the number of triangles of the mesh
- Core-seconds of a case as a function of the terrain's number of samples
- Wall-clock seconds of a campaign as a function of its number of cases
- Wall-clock seconds of a campaign as a function of the number of local or Dask workers; its cases only wait
- Core-seconds of a report as a function of the number of cases
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from pydantic import BaseModel

from benchmarks.engine import BusyParameters, BusyScenario, Stopwatch
from benchmarks.images import descent_pose, descent_scene
from benchmarks.reporting import run_marsyard, synthetic_campaign
from benchmarks.timing import core_seconds
from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.campaign_file import CampaignDefinition, Retain
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.execution.executors import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.scenarios.descent.images import camera_optics
from marsyard.scenarios.descent.parameters import DescentCameraParameters
from marsyard.scenarios.interface import CaseResult
from marsyard.sim.render import PixelRays, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.streams import Streams

RESULTS = Path(__file__).parent / "results" / "growth.json"
FIGURE = Path(__file__).parents[1] / "docs" / "images" / "growth.svg"
#: Waiting time of a case of `WaitingScenario`, s.
WAITING_S = 0.02


@dataclass(frozen=True)
class Curve:
    """Cost as a function of one size.

    - name: Name of the curve
    - size, cost: Labels of the axes with units
    - points: Pairs (size, cost)
    """

    name: str
    size: str
    cost: str
    points: Sequence[tuple[float, float]]

    @property
    def power(self) -> float:
        """Exponent of the power law between the two largest sizes."""
        (smaller, smaller_cost), (larger, larger_cost) = self.points[-2:]
        return float(np.log(larger_cost / smaller_cost) / np.log(larger / smaller))


class WaitingScenario(BusyScenario):
    """Scenario that waits without computing, so that the number of cores does not limit the number of workers."""

    name = "waiting"

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        assert isinstance(parameters, BusyParameters)
        time.sleep(parameters.busy_s)
        return CaseResult("VALID", True, {"number": streams.case})


def measure_curves() -> list[Curve]:
    """Measure all curves."""
    return [
        Curve("frame vs. pixels", "pixels", "core-s", _measure_image_sizes((128, 256, 512, 1024))),
        Curve("frame vs. triangles", "triangles of the mesh", "core-s", _measure_meshes((65, 129, 257, 513, 1025))),
        Curve(
            "case vs. terrain size", "posts of the terrain", "core-s", _measure_terrain_sizes((512, 1024, 2048, 4096))
        ),
        Curve("campaign vs. cases", "empty cases", "wall s", _measure_case_counts((1_000, 10_000, 100_000))),
        Curve("campaign vs. workers", "workers", "wall s", _measure_workers((1, 2, 4, 8))),
        Curve("campaign vs. Dask workers", "workers", "wall s", _measure_dask_workers((1, 2, 4))),
        Curve("report vs. cases", "cases", "core-s", _measure_reports((100, 1_000, 10_000, 100_000, 1_000_000))),
    ]


def _measure_image_sizes(sides: Sequence[int]) -> list[tuple[float, float]]:
    """Measure a frame cropped to squares with these sides, pixels."""
    scene, surface = descent_scene()
    camera, pose = camera_optics(DescentCameraParameters()).camera, descent_pose(surface)
    renderer = process_renderer(default_backend())
    points = []
    for side in sides:
        corner = (camera.size[0] - side) // 2
        rays = PixelRays.from_camera(camera.crop(corner, corner, (side, side)))
        points.append((float(side**2), _min_core_seconds(partial(renderer.render, scene, rays, pose))))
    return points


def _measure_meshes(lines: Sequence[int]) -> list[tuple[float, float]]:
    """Measure a frame with square meshes of these numbers of grid lines per axis."""
    scene, surface = descent_scene()
    rays, pose = camera_optics(DescentCameraParameters()).rays, descent_pose(surface)
    renderer = process_renderer(default_backend())
    points = []
    for count in lines:
        # same extent as the default mesh: fewer lines have a wider spacing
        spacing_m = scene.mesh_finest_m * (scene.mesh_lines - 1) / (count - 1)
        scene_with_mesh = replace(scene, mesh_lines=count, mesh_finest_m=spacing_m)
        cost = _min_core_seconds(partial(renderer.render, scene_with_mesh, rays, pose))
        points.append((2.0 * (count - 1) ** 2, cost))
    return points


def _measure_terrain_sizes(samples: Sequence[int]) -> list[tuple[float, float]]:
    """Measure a case over prepared terrains with these numbers of samples per axis."""
    points = []
    for count in samples:
        campaign = load_campaign("dimes-smoke", [f"terrain.samples={count}", "location.bank=1"])
        campaign.scenario.prepare(campaign.base_parameters(), 0)
        # always the same case, because run times differ between cases
        run = partial(campaign.scenario.run, campaign.parameters(0), campaign.streams(0))
        points.append((float(count**2), _min_core_seconds(run)))
    return points


def _measure_case_counts(cases: Sequence[int]) -> list[tuple[float, float]]:
    """Measure campaigns of empty cases on one worker."""
    return [(float(count), _measure_campaign_s(count, 0.0, ExecutorConfig(1))) for count in cases]


def _measure_workers(jobs: Sequence[int]) -> list[tuple[float, float]]:
    """Measure a campaign of 400 waiting cases on local workers."""
    return [(float(count), _measure_campaign_s(400, WAITING_S, ExecutorConfig(count))) for count in jobs]


def _measure_dask_workers(workers: Sequence[int]) -> list[tuple[float, float]]:
    """Measure a campaign of 400 waiting cases on a local Dask cluster."""
    return [
        (float(count), _measure_campaign_s(400, WAITING_S, ExecutorConfig(cluster=f"local:{count}")))
        for count in workers
    ]


def _measure_campaign_s(cases: int, waiting_s: float, executor: ExecutorConfig) -> float:
    """Run a campaign; return the wall-clock time from the first to the last completed case."""
    scenario = "benchmarks.growth:WaitingScenario" if waiting_s else "benchmarks.engine:BusyScenario"
    definition = CampaignDefinition(
        name="growth", scenario=scenario, cases=cases, parameters={"busy_s": waiting_s}, retain=Retain(showcase="none")
    )
    stopwatch = Stopwatch((1, cases))
    with TemporaryDirectory() as folder:
        instance = WaitingScenario() if waiting_s else BusyScenario()
        run_campaign(Campaign(definition, instance), Path(folder, "run"), executor, stopwatch)
    return stopwatch.records[cases][0] - stopwatch.records[1][0]


def _measure_reports(cases: Sequence[int]) -> list[tuple[float, float]]:
    """Measure the report of synthetic campaigns with these numbers of cases."""
    with TemporaryDirectory() as folder:
        runs = [(count, synthetic_campaign(Path(folder, f"of-{count}"), count)) for count in cases]
        return [(float(count), run_marsyard("report", str(run)).core_s) for count, run in runs]


def _min_core_seconds(run: Callable[[], object]) -> float:
    """Return the minimum core-seconds of three runs, because other programs only add time."""
    return min(core_seconds(run, 3))


def draw_curves(curves: Sequence[Curve]) -> Figure:
    """Draw one panel per curve, with logarithmic axes that span at least one decade of cost."""
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    panels = figure.subplots(2, 4).ravel()
    for axes, curve in zip(panels, curves, strict=False):
        sizes, costs = zip(*curve.points, strict=True)
        axes.loglog(sizes, costs, "o-", color="#33598f")
        axes.set_title(f"{curve.name}\n(largest sizes: size$^{{{curve.power:.2f}}}$)", fontsize=8)
        axes.set_xlabel(curve.size, fontsize=8)
        axes.set_ylabel(curve.cost, fontsize=8)
        axes.tick_params(labelsize=7, which="both")
        middle, half_range = np.sqrt(min(costs) * max(costs)), np.sqrt(max(10.0, 1.5 * max(costs) / min(costs)))
        axes.set_ylim(middle / half_range, middle * half_range)
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        if max(sizes) < 10.0 * min(sizes):
            axes.set_xticks(sizes, [f"{size:g}" for size in sizes], minor=False)
            axes.set_xticks([], minor=True)
        axes.grid(visible=True, color="0.9")
    for axes in panels[len(curves) :]:
        axes.set_axis_off()
    return figure


def main() -> None:
    """Measure, store and draw the curves."""
    cv2.setNumThreads(1)
    mpl.rcParams["svg.hashsalt"] = "marsyard"
    curves = measure_curves()
    for curve in curves:
        points = ", ".join(f"{size:g}: {cost:.3g}" for size, cost in curve.points)
        print(f"{curve.name:<32}{points} {curve.cost}; largest sizes: size^{curve.power:.2f}")
    RESULTS.parent.mkdir(exist_ok=True)
    RESULTS.write_text(json.dumps([asdict(curve) for curve in curves], indent=1) + "\n")
    draw_curves(curves).savefig(FIGURE, metadata={"Date": None})
    print(f"stored in {RESULTS}, drawn as {FIGURE}")


if __name__ == "__main__":
    main()
