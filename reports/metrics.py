"""Metrics of a campaign, which are compared with another campaign (`campaign_diff`) or earlier nights (`nightly`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float, Int

from marsyard.reports import populations, rates
from marsyard.reports.column_selection import primary_metric
from marsyard.reports.column_values import numbers
from marsyard.reports.decision import requirement_masks
from marsyard.reports.sampling_design import read_sampling_design
from marsyard.reports.statistics.difference_tests import Sample
from marsyard.reports.stored import StoredRun
from marsyard.reports.wording import label


@dataclass(frozen=True)
class Metric:
    """One metric of a campaign: a success rate with the values 0 and 1, or an error's magnitude, for each case."""

    name: str
    is_rate: bool
    sample: Sample

    @property
    def finite_values(self) -> Float[np.ndarray, " finite"]:
        """Values of the cases that are not excluded."""
        return self.sample.finite_cases().values

    @property
    def summary(self) -> float:
        """The rate, or the median error; NaN for no cases."""
        values = self.finite_values
        if values.size == 0:
            return math.nan
        return float(values.mean() if self.is_rate else np.median(values))


def list_metrics(run: StoredRun) -> tuple[pd.DataFrame, list[Metric]]:
    """Return the rows without the nominal case, and the metrics that can be compared between campaigns.

    Metrics: success of each requirement, errors, "answered", and "came to an end" (the case was completed).
    """
    frame = read_sampling_design(run.definition).exclude_nominal_case(run.all_cases)
    metrics: dict[str, Metric] = {}
    terrains = number_stored_terrains(frame)

    def add_metric(name: str, values: Float[np.ndarray, " n"], title: str = "", *, is_rate: bool = True) -> None:
        metrics[name] = Metric(title or name, is_rate, Sample(values, terrains))

    error_columns = dict.fromkeys([primary_metric(frame, run.requirements)])
    for requirement in run.requirements:
        name, metric = str(requirement.get("id", "?")), str(requirement.get("metric", ""))
        masks = requirement_masks(frame, requirement)
        if masks is None:
            continue
        member, success = masks
        add_metric(name, np.where(member, success.astype(np.float64), np.nan))
        if metric in frame and isinstance(requirement.get("bound"), int | float):
            error_columns[metric] = None
    for column in filter(None, error_columns):
        magnitude = np.abs(numbers(frame, column))
        add_metric(column, np.where(np.isfinite(magnitude), magnitude, np.nan), label(column), is_rate=False)
    if populations.is_flag(frame, "answered"):
        add_metric("answered", populations.population_mask(frame, "valid").astype(np.float64))
    add_metric("came to an end", populations.population_mask(frame, "completed").astype(np.float64))
    return frame, list(metrics.values())


def number_stored_terrains(frame: pd.DataFrame) -> Int[np.ndarray, " n"]:
    """Return the stored terrain numbers of cases, which are comparable between campaigns; 0 without any terrain."""
    groups = rates.terrain_groups(frame)
    if groups is None:
        return np.zeros(len(frame), dtype=np.int64)
    terrains = pd.to_numeric(frame["terrain"], errors="coerce").to_numpy(dtype=np.float64, na_value=np.nan)
    # negative numbers: one for each case of unknown terrain, and one for each terrain without a number
    return np.where(np.isfinite(terrains), np.nan_to_num(terrains), -1.0 - groups).astype(np.int64)
