"""Select the executor of a campaign: processes on this machine, or a cluster."""

import os
from contextlib import AbstractContextManager
from dataclasses import dataclass

from marsyard.campaigns.execution.cluster import ClusterExecutor
from marsyard.campaigns.execution.work import Executor
from marsyard.campaigns.execution.workers import LocalExecutor


@dataclass(frozen=True)
class ExecutorConfig:
    """Parameters of an executor: `jobs` worker processes on this machine, or a cluster if `cluster` is set.

    `cluster` is the address of a Dask scheduler (`tcp://host:8786`), or `local:N` for a new local cluster of N workers.
    """

    jobs: int = 1
    cluster: str | None = None

    def describe(self) -> str:
        """Describe the executor for the campaign's record, without the names of hosts."""
        if self.cluster is None:
            return f"{self.jobs} on this machine"
        return f"cluster {self.cluster}" if self.cluster.startswith("local:") else "cluster"


def create_executor(config: ExecutorConfig) -> AbstractContextManager[Executor]:
    """Create an executor as a context; at the end its workers end, or are killed after an exception.

    Raises CampaignError if the cluster cannot be reached or Dask is not installed.
    """
    return LocalExecutor(config.jobs) if config.cluster is None else ClusterExecutor(config.cluster)


def available_cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
