"""Execution of cases on a Dask cluster, with the same isolation as on one machine.

Dask workers do not run cases themselves. For each thread, a Dask worker starts and monitors one worker process, which
runs the batches with the same limits as on one machine (`marsyard.campaigns.execution.workers`). A case that hangs,
exhausts memory or kills its process therefore affects only that process. If a Dask worker itself is lost, Dask sends
its batches to other workers. If a batch was lost with several workers (Dask's `allowed-failures`, by default 3), it is
divided into single cases; a case that is lost again in this way counts as crashed.
"""

from __future__ import annotations

import multiprocessing.process
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from typing import Any, TypeVar

from marsyard.campaigns.definition.identity import hash_code, read_versions
from marsyard.campaigns.errors import CRASHED, CampaignError, WorkerExitError
from marsyard.campaigns.execution.worker_process import TaskResult, Work
from marsyard.campaigns.execution.workers import Batches, LocalExecutor

Result = TypeVar("Result")
#: Prefix of the address of a new cluster on this machine.
_LOCAL_PREFIX = "local:"
#: Seconds to wait for a scheduler, and for the first worker.
_TIMEOUT_S = 30
#: Batches queued at each Dask worker, so that no worker waits for the network.
_QUEUED_BATCHES = 2
#: Worker process of each thread of a Dask worker (attribute `workers`).
_thread_state = threading.local()


class ClusterExecutor(AbstractContextManager["ClusterExecutor"]):
    """Executor on the workers of a Dask cluster, as a context.

    address: address of a scheduler (`tcp://host:8786`), or `local:N` for a cluster of N workers on this machine
    Raises CampaignError if Dask is missing, the cluster cannot be reached, or its workers run other code.
    """

    def __init__(self, address: str) -> None:
        try:
            import distributed
        except ImportError as error:
            raise CampaignError("a cluster needs Dask: pip install 'marsyard[dask]'") from error
        self._distributed = distributed
        with ExitStack() as stack:
            try:
                cluster: Any = None
                if not address.startswith(_LOCAL_PREFIX):
                    # Check the address first. Dask does not close a client with an invalid address; its later garbage
                    # collection can block the next client for 10 s.
                    distributed.comm.get_address_host_port(address)
                else:
                    cluster = _start_local_cluster(address)
                    stack.callback(cluster.close)
                self._client = distributed.Client(cluster or address, timeout=_TIMEOUT_S, set_as_default=False)
                stack.callback(self._client.close)
            except (OSError, ValueError, ImportError) as error:
                raise CampaignError(f"--cluster {address}: no scheduler responds: {error}") from error
            try:
                self._client.wait_for_workers(1, timeout=_TIMEOUT_S)
                identities = self._client.run(_identify_code)
            except TimeoutError as error:
                raise CampaignError(f"--cluster {address}: the scheduler has no workers") from error
            local_code, local_versions = _identify_code()
            for worker, (code, versions) in identities.items():
                if code != local_code:
                    raise CampaignError(f"worker {worker} runs a different Marsyard source code than this program")
                differing = sorted(name for name in local_versions if local_versions[name] != versions.get(name))
                if differing:
                    pairs = (f"{name} {versions.get(name)} (here {local_versions[name]})" for name in differing)
                    raise CampaignError(f"worker {worker} has different versions: {', '.join(pairs)}")
            self._stack = stack.pop_all()

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def run(self, work: Work[Result]) -> Iterator[list[TaskResult[Result]]]:
        """Run work as described in `Executor.run`."""
        machines: Counter[str] = Counter()
        for worker in self._client.scheduler_info(n_workers=-1)["workers"].values():
            machines[worker["host"]] += worker["nthreads"]
        # each thread starts one executor; the executors of a machine share its memory
        executors_per_machine = max(machines.values(), default=1)
        threads = sum(self._client.nthreads().values())
        batches = Batches(work.items, work.total, threads)
        pending = self._distributed.as_completed(loop=self._client.loop)
        batches_by_future: dict[Any, Sequence[int]] = {}

        def submit_batch(batch: Sequence[int]) -> None:
            if batch:
                batch_work = replace(work, items=tuple(batch), total=len(batch))
                future = self._client.submit(_run_batch_isolated, batch_work, executors_per_machine, pure=False)
                batches_by_future[future] = batch
                pending.add(future)

        try:
            for _ in range(_QUEUED_BATCHES * threads):
                submit_batch(batches.next())
            while batches_by_future:
                future = next(pending)
                batch = batches_by_future.pop(future)
                results = self._collect(future, batch, batches)
                if results is None:
                    for item in batch:
                        submit_batch((item,))
                else:
                    submit_batch(batches.next())
                future.release()
                if results:
                    yield results
        finally:
            self._client.cancel(list(batches_by_future))

    def _collect(self, future: Any, batch: Sequence[int], batches: Batches) -> list[TaskResult[Any]] | None:
        """Return the results of a batch; None if it was lost with its workers and must be divided into cases."""
        error = future.exception() if future.status != "cancelled" else CancelledError("the cluster abandoned it")
        if error is None:
            seconds, results = future.result()
            batches.record_time(len(batch), seconds)
            return list(results)
        if isinstance(error, CampaignError):
            raise error
        if len(batch) > 1:
            return None
        if isinstance(error, (self._distributed.scheduler.KilledWorker, CancelledError)):
            error = WorkerExitError(CRASHED, "its Dask workers died in succession", "")
        return [TaskResult(batch[0], None, error if isinstance(error, Exception) else RuntimeError(repr(error)))]


def _start_local_cluster(address: str) -> Any:
    """Start a Dask cluster with N workers on this machine, for the address `local:N`."""
    from distributed import LocalCluster

    number = address.removeprefix(_LOCAL_PREFIX)
    if not (number.isdecimal() and int(number) >= 1):
        raise CampaignError(f"--cluster {address}: expected local:N, with N at least 1")
    # the memory limit applies to the worker processes of the cases, not to the Dask workers
    worker_options: dict[str, Any] = {"n_workers": int(number), "threads_per_worker": 1, "processes": True}
    return LocalCluster(**worker_options, dashboard_address=None, memory_limit=0, silence_logs="ERROR")


def _identify_code() -> tuple[str, dict[str, str]]:
    """Return the hash of the code and the versions of the packages in this process."""
    return hash_code(()), read_versions()


def _run_batch_isolated(work: Work[Result], executors: int) -> tuple[float, list[TaskResult[Result]]]:
    """Run a batch in the worker process of this Dask thread; return the duration in seconds and the results."""
    start_s = time.perf_counter()
    workers: LocalExecutor | None = getattr(_thread_state, "workers", None)
    if workers is None:
        # Dask's workers are daemons of `multiprocessing`, which must not have children. The kernel ends the children
        # together with the thread that started them.
        multiprocessing.process.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
        workers = _thread_state.workers = LocalExecutor(1, executors)
    results = [result for batch in workers.run(work) for result in batch]
    return time.perf_counter() - start_s, results
