"""Who runs a campaign: worker processes of this machine, or a cluster."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from marsyard.campaigns.execution.work import Workers
from marsyard.campaigns.execution.workers import LocalWorkers


@dataclass(frozen=True)
class Crew:
    """Worker processes on this machine, `jobs` of them; or those of a cluster where one is named.

    `cluster` is the address of a Dask scheduler (`tcp://host:8786`) or `local:N`, a cluster of N workers made here.
    """

    jobs: int = 1
    cluster: str | None = None

    def describe(self) -> str:
        """As it stands in the record."""
        return f"{self.jobs} on this machine" if self.cluster is None else f"cluster {self.cluster}"


@contextmanager
def hire(crew: Crew) -> Iterator[Workers]:
    """The workers of a crew; left by an exception they are killed, otherwise they end.

    Raises
    ------
    CampaignError
        Where the cluster cannot be reached, or Dask is not installed.
    """
    if crew.cluster is None:
        with LocalWorkers(crew.jobs) as workers:
            yield workers
        return
    from marsyard.campaigns.execution.cluster import ClusterWorkers

    with ClusterWorkers(crew.cluster) as cluster:
        yield cluster
