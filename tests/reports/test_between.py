from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from marsyard.reports.comparison import Contrast, Figure, campaign_diff_grid, compare_campaigns, figures_of, sample_of
from marsyard.reports.statistics.changes import difference_p
from marsyard.reports.stored import StoredRun, read_run

Rows = Callable[..., pd.DataFrame]
MakeRun = Callable[..., Path]


def _contrasts(first: Path, second: Path) -> tuple[bool, dict[str, Contrast]]:
    paired, found = compare_campaigns(read_run(first), read_run(second))
    return paired, {one.name: one for one in found}


def test_the_same_draws_are_compared_in_pairs(make_rows: Rows, make_run: MakeRun) -> None:
    frame = make_rows(200, terrains=40)
    worse = frame.assign(velocity_error_m_s=frame["velocity_error_m_s"] * 1.02)
    paired, found = _contrasts(make_run(frame), make_run(worse, name="other"))
    assert paired
    # Every error has grown by 2 %: pairs show it although the scatter is many times as wide.
    assert found["velocity error (m/s)"].p_value < 1e-9
    assert found["answered"].p_value == 1.0
    assert found["came to an end"].second.level == 1.0
    # Four terrains say nothing of others, however many cases they bear: four signs alike, twice, of four figures.
    few = make_rows(200)
    worse = few.assign(velocity_error_m_s=few["velocity_error_m_s"] * 1.02)
    _, found = _contrasts(make_run(few, name="few"), make_run(worse, name="few-other"))
    assert found["velocity error (m/s)"].p_value == pytest.approx(4 * 2 / 2**4)


def test_draws_of_their_own_are_compared_as_two_samples(make_rows: Rows, make_run: MakeRun) -> None:
    first = make_run(make_rows(300))
    paired, found = _contrasts(first, make_run(make_rows(300, seed=2), name="same", seed=8))
    assert not paired
    assert min(one.p_value for one in found.values()) > 0.01
    _, changed = _contrasts(first, make_run(make_rows(300, seed=2, answered=0.6, spread=2.0), name="worse", seed=8))
    assert changed["answered"].p_value < 1e-6
    # of 10,000 permutations none goes as far
    assert changed["velocity error (m/s)"].p_value < 1e-3
    grid = campaign_diff_grid(["a", "b"], list(changed.values()))
    assert ["answered", "< 0.001"] in [[row[0], row[-1]] for row in grid.rows]


def test_terrains_of_other_sites_are_other_terrains(make_rows: Rows, make_run: MakeRun) -> None:
    # Errors go with the terrain. Of two sites terrain 3 is not the same: nothing has changed but the draw of
    # terrains, which number by number is taken for a change in 7 of 9 pairs of draws.
    def run(name: str, seed: int) -> Path:
        level = np.random.default_rng(seed).uniform(1.0, 3.0, 20)
        frame = make_rows(400, terrains=20, answered=1.0, seed=seed)
        frame["velocity_error_m_s"] = level[frame["terrain"]] + 0.1 * np.arange(400) / 400
        configuration = {"parameters": {"site": name}}
        return make_run(frame, name=name, seed=seed, configuration=configuration)

    here, there = read_run(run("gusev", 1)), read_run(run("meridiani", 6))
    assert min(one.p_value for one in compare_campaigns(here, there)[1]) > 0.05
    mine, its = (sample_of(*_errors(one)) for one in (here, there))
    assert difference_p(mine, its) < 1e-3


def _errors(run: StoredRun) -> tuple[pd.DataFrame, Figure]:
    frame, found = figures_of(run)
    return frame, next(one for one in found if one.name == "velocity error (m/s)")


def test_campaigns_with_nothing_in_common(make_rows: Rows, make_run: MakeRun) -> None:
    first = make_run(make_rows(20)[["case", "outcome"]], [])
    _, found = _contrasts(first, make_run(make_rows(20), name="other", seed=8))
    assert set(found) == {"came to an end"}
