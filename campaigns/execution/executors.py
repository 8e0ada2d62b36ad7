"""Select the executor of a campaign: processes on this machine, or a cluster."""

from __future__ import annotations

from contextlib import AbstractContextManager

from marsyard.campaigns.execution.cluster import ClusterExecutor
from marsyard.campaigns.execution.worker_process import Executor
from marsyard.campaigns.execution.workers import ExecutorConfig, LocalExecutor


def create_executor(config: ExecutorConfig) -> AbstractContextManager[Executor]:
    """Create an executor as a context; at the end its workers end, or are killed after an exception.

    Raises CampaignError if the cluster cannot be reached or Dask is not installed.
    """
    return LocalExecutor(config.jobs) if config.cluster is None else ClusterExecutor(config.cluster)
