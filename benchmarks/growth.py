"""Growth of costs with size: ``python -m benchmarks.growth`` draws docs/images/growth.svg.

Frame over pixels and triangles, case over terrain size, campaign over cases and workers (local workers and Dask, with
cases that wait), report over cases. Core-seconds; wall-clock time for the number of workers.
"""

from __future__ import annotations

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
from benchmarks.pictures import descent_pose, descent_scene
from benchmarks.reporting import marsyard, synthetic_campaign
from benchmarks.timing import core_seconds
from marsyard.campaigns.definition.campaign import Campaign
from marsyard.campaigns.definition.configuration import CampaignConfiguration, Retain
from marsyard.campaigns.definition.loading import load_campaign
from marsyard.campaigns.execution.workers import ExecutorConfig
from marsyard.campaigns.running.engine import run_campaign
from marsyard.scenarios.descent.exposure import camera_optics
from marsyard.scenarios.descent.parameters import CameraParameters
from marsyard.scenarios.interface import CaseResult
from marsyard.sim.render import PixelRays, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.streams import Streams

KEPT = Path(__file__).parent / "results" / "growth.json"
FIGURE = Path(__file__).parents[1] / "docs" / "images" / "growth.svg"
#: Waiting time of a light case, s.
LIGHT_S = 0.02


@dataclass(frozen=True)
class Curve:
    """Cost as a function of one size.

    Attributes
    ----------
    name
        Name of the curve.
    size, cost
        Labels of the axes with units.
    points
        Pairs (size, cost).
    """

    name: str
    size: str
    cost: str
    points: Sequence[tuple[float, float]]

    @property
    def power(self) -> float:
        """Exponent of the power law between the two largest sizes."""
        (before, cheap), (last, dear) = self.points[-2:]
        return float(np.log(dear / cheap) / np.log(last / before))


class LightScenario(BusyScenario):
    """Wait without computing, so that the number of cores does not limit the number of workers."""

    name = "light"

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        assert isinstance(parameters, BusyParameters)
        time.sleep(parameters.busy_s)
        return CaseResult("VALID", True, {"number": streams.case})


def curves() -> list[Curve]:
    """Measure all curves."""
    return [
        Curve("frame over pixels", "pixels", "core-s", _frames_of_sizes((128, 256, 512, 1024))),
        Curve("frame over triangles", "triangles of the mesh", "core-s", _frames_of_meshes((65, 129, 257, 513, 1025))),
        Curve("case over terrain", "posts of the terrain", "core-s", _cases_over_terrains((512, 1024, 2048, 4096))),
        Curve("campaign over cases", "empty cases", "wall s", _campaigns((1_000, 10_000, 100_000))),
        Curve("campaign over workers", "light workers", "wall s", _crews((1, 2, 4, 8))),
        Curve("campaign over Dask's workers", "light workers", "wall s", _clusters((1, 2, 4))),
        Curve("report over cases", "cases", "core-s", _reports((100, 1_000, 10_000, 100_000, 1_000_000))),
    ]


def _frames_of_sizes(sides: Sequence[int]) -> list[tuple[float, float]]:
    scene, surface = descent_scene()
    camera, pose = camera_optics(CameraParameters()).camera, descent_pose(surface)
    renderer = process_renderer(default_backend())
    points = []
    for side in sides:
        corner = (camera.size[0] - side) // 2
        rays = PixelRays.of(camera.crop(corner, corner, (side, side)))
        points.append((float(side**2), _minimum(partial(renderer.render, scene, rays, pose))))
    return points


def _frames_of_meshes(lines: Sequence[int]) -> list[tuple[float, float]]:
    scene, surface = descent_scene()
    rays, pose = camera_optics(CameraParameters()).rays, descent_pose(surface)
    renderer = process_renderer(default_backend())
    points = []
    for count in lines:
        # same extent as the default mesh, with wider spacing for fewer lines
        finest = scene.mesh_finest_m * (scene.mesh_lines - 1) / (count - 1)
        of_count = replace(scene, mesh_lines=count, mesh_finest_m=finest)
        cost = _minimum(partial(renderer.render, of_count, rays, pose))
        points.append((2.0 * (count - 1) ** 2, cost))
    return points


def _cases_over_terrains(samples: Sequence[int]) -> list[tuple[float, float]]:
    points = []
    for count in samples:
        campaign = load_campaign("dimes-smoke", [f"terrain.samples={count}", "retain.showcase=none"])
        # always the same case, because run times differ between cases
        parameters = campaign.with_values({**campaign.draws(0), "location.terrain": 0})
        run = partial(campaign.scenario.run, parameters, campaign.streams(0))
        points.append((float(count**2), _minimum(run)))
    return points


def _campaigns(cases: Sequence[int]) -> list[tuple[float, float]]:
    return [(float(count), _campaign_s(count, 0.0, ExecutorConfig(1))) for count in cases]


def _crews(jobs: Sequence[int]) -> list[tuple[float, float]]:
    return [(float(count), _campaign_s(400, LIGHT_S, ExecutorConfig(count))) for count in jobs]


def _clusters(workers: Sequence[int]) -> list[tuple[float, float]]:
    return [(float(count), _campaign_s(400, LIGHT_S, ExecutorConfig(cluster=f"local:{count}"))) for count in workers]


def _campaign_s(cases: int, waiting_s: float, executor: ExecutorConfig) -> float:
    """Wall-clock time from the first to the last completed case."""
    scenario = "benchmarks.growth:LightScenario" if waiting_s else "benchmarks.engine:BusyScenario"
    configuration = CampaignConfiguration(
        name="growth", scenario=scenario, cases=cases, parameters={"busy_s": waiting_s}, retain=Retain(showcase="none")
    )
    watch = Stopwatch((1, cases))
    with TemporaryDirectory() as folder:
        waiting = LightScenario() if waiting_s else BusyScenario()
        run_campaign(Campaign(configuration, waiting), Path(folder, "run"), executor, watch)
    return watch.at[cases][0] - watch.at[1][0]


def _reports(cases: Sequence[int]) -> list[tuple[float, float]]:
    with TemporaryDirectory() as folder:
        runs = [(count, synthetic_campaign(Path(folder, f"of-{count}"), count)) for count in cases]
        return [(float(count), marsyard("report", str(run)).core_s) for count, run in runs]


def _minimum(run: Callable[[], object]) -> float:
    """Minimum of three runs, because other programs only add time."""
    return min(core_seconds(run, 3))


def draw(found: Sequence[Curve]) -> Figure:
    """Draw one panel per curve, with logarithmic axes that span at least one decade of cost."""
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    panels = figure.subplots(2, 4).ravel()
    for axes, curve in zip(panels, found, strict=False):
        sizes, costs = zip(*curve.points, strict=True)
        axes.loglog(sizes, costs, "o-", color="#33598f")
        axes.set_title(f"{curve.name}\n(size$^{{{curve.power:.2f}}}$ at the end)", fontsize=8)
        axes.set_xlabel(curve.size, fontsize=8)
        axes.set_ylabel(curve.cost, fontsize=8)
        axes.tick_params(labelsize=7, which="both")
        middle, reach = np.sqrt(min(costs) * max(costs)), np.sqrt(max(10.0, 1.5 * max(costs) / min(costs)))
        axes.set_ylim(middle / reach, middle * reach)
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        if max(sizes) < 10.0 * min(sizes):
            axes.set_xticks(sizes, [f"{size:g}" for size in sizes], minor=False)
            axes.set_xticks([], minor=True)
        axes.grid(visible=True, color="0.9")
    for axes in panels[len(found) :]:
        axes.set_axis_off()
    return figure


def main() -> None:
    """Measure, store and draw."""
    cv2.setNumThreads(1)
    mpl.rcParams["svg.hashsalt"] = "marsyard"
    measured = curves()
    for curve in measured:
        points = ", ".join(f"{size:g}: {cost:.3g}" for size, cost in curve.points)
        print(f"{curve.name:<32}{points} {curve.cost}; size^{curve.power:.2f} at the end")
    KEPT.parent.mkdir(exist_ok=True)
    KEPT.write_text(json.dumps([asdict(curve) for curve in measured], indent=1) + "\n")
    draw(measured).savefig(FIGURE, metadata={"Date": None})
    print(f"kept in {KEPT}, drawn as {FIGURE}")


if __name__ == "__main__":
    main()
