"""Execution of cases on a Dask cluster, with the same isolation as on one machine.

Dask workers do not run cases themselves. For each thread, a Dask worker starts and monitors one worker process, which
runs the batches with the same limits as on one machine (`marsyard.campaigns.execution.workers`). A case that hangs,
exhausts memory or kills its process therefore affects only that process.

If a Dask worker itself is lost, Dask sends its batches to other workers. If a batch was lost with several workers
(Dask's `allowed-failures`, by default 3), it is divided into single cases; a case that is lost again in this way counts
as crashed. Workers may join and leave at any time. If the scheduler is restarted at the same address, Dask's client
connects again and cancels all unfinished batches; the executor submits them again.
"""

import multiprocessing.process
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import replace
from functools import cache
from typing import Any, TypeVar

from marsyard.campaigns.definition.identity import hash_code, read_versions
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.batches import Batches
from marsyard.campaigns.execution.work import TaskResult, Work
from marsyard.campaigns.execution.workers import LocalExecutor
from marsyard.campaigns.outcomes import CRASHED, WorkerExitError

Result = TypeVar("Result")
#: Prefix of the address of a new cluster on this machine.
_LOCAL_PREFIX = "local:"
#: Seconds to wait for a scheduler, at the start and if it is restarted, and for a cluster without workers: a batch
#: system may start them only after submission.
_TIMEOUT_S, _NO_WORKERS_S = 60, 3600
#: Time between two requests for the list of workers, and between two checks for finished batches, s.
_REFRESH_S, _POLL_S = 10.0, 0.02
#: Batches queued at each Dask worker, so that no worker waits for the network.
_QUEUED_BATCHES = 2
#: Advice after an error that ends the campaign.
_ADVICE = "the finished cases are stored, `marsyard resume` continues"
#: Maximum number of times that the cluster may abandon a single case.
_MAX_ABANDONED = 5
#: Executor of each thread of a Dask worker (`executor`), and the number of executors that share the memory of its
#: machine (`executor_count`).
_thread_state = threading.local()


#: Hash of the source code, and versions of the packages: plain types, which any worker can read.
CodeIdentity = tuple[str, tuple[tuple[str, str], ...]]


def check_identity(worker: str, theirs: CodeIdentity, ours: CodeIdentity) -> None:
    """Compare the code of a worker with that of the client. Raises CampaignError if they differ."""
    (their_code, their_pairs), (our_code, our_pairs) = theirs, ours
    if their_code != our_code:
        raise CampaignError(f"worker {worker} runs a different Marsyard source code than this program")
    their_versions = dict(their_pairs)
    differing = [(name, version) for name, version in our_pairs if version != their_versions.get(name)]
    if differing:
        pairs = (f"{name} {their_versions.get(name)} (here {version})" for name, version in differing)
        raise CampaignError(f"worker {worker} has different versions: {', '.join(pairs)}")


class ClusterExecutor(AbstractContextManager["ClusterExecutor"]):
    """Executor on the workers of a Dask cluster, as a context.

    address: address of a scheduler (`tcp://host:8786`), or `local:N` for a cluster of N workers on this machine
    Raises CampaignError if Dask is missing, or no scheduler responds.
    """

    def __init__(self, address: str) -> None:
        try:
            import distributed
        except ImportError as error:
            raise CampaignError("a cluster needs Dask: pip install 'marsyard[dask]'") from error
        self._distributed, self._address = distributed, address
        self._checked: set[str] = set()
        with ExitStack() as stack:
            self._cluster: Any = None
            try:
                if address.startswith(_LOCAL_PREFIX):
                    self._cluster = _start_local_cluster(address)
                    stack.callback(self._cluster.close)
                else:
                    # Check the address first. Dask does not close a client with an invalid address; its later garbage
                    # collection can block the next client for 10 s.
                    distributed.comm.get_address_host_port(address)
                self._client = distributed.Client(self._cluster or address, timeout=_TIMEOUT_S, set_as_default=False)
            except (OSError, ValueError, ImportError) as error:
                raise CampaignError(f"--cluster {address}: no scheduler responds: {error}") from error
            stack.callback(self._disconnect)
            self._stack = stack.pop_all()

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _disconnect(self) -> None:
        with suppress(OSError, TimeoutError):
            self._client.close()

    def run(self, work: Work[Result]) -> Iterator[list[TaskResult[Result]]]:
        """Run work as described in `Executor.run`. Raises CampaignError if a worker runs other code."""
        queue = _BatchQueue(self, work)
        try:
            yield from queue.results()
        finally:
            queue.cancel()

    def submit(self, work: Work[Any], executors: int) -> Any:
        """Submit a batch; return its future. `executors` share the memory of a machine."""
        return self._client.submit(_run_batch_isolated, work, executors, identify_code(), pure=False)

    def cancel(self, futures: Sequence[Any]) -> None:
        """Cancel futures; without a scheduler there are none."""
        if self._client.status == "running":
            self._client.cancel(futures)

    def is_connected(self) -> bool:
        """Whether the scheduler is connected. Raises CampaignError if it was lost, and did not return in time."""
        if self._client.status == "closed":
            raise CampaignError(f"--cluster {self._address}: the scheduler is lost; {_ADVICE}")
        return bool(self._client.status == "running")

    def count_threads(self) -> tuple[int, int]:
        """Return the number of threads of all workers, and the largest number of threads on one machine.

        Raises CampaignError if a new worker does not run the same code.
        """
        workers = self._client.scheduler_info(n_workers=-1)["workers"]
        self._check_workers([address for address in workers if address not in self._checked])
        machines: Counter[str] = Counter()
        for worker in workers.values():
            machines[worker["host"]] += worker["nthreads"]
        return machines.total(), max(machines.values(), default=1)

    def _check_workers(self, addresses: list[str]) -> None:
        """Compare the code of workers with that of the client; a worker that has left is omitted."""
        if not addresses:
            return
        identities = self._client.run(identify_code, workers=addresses, on_error="return")
        for address, identity in identities.items():
            if isinstance(identity, OSError):
                continue
            if isinstance(identity, BaseException):
                raise CampaignError(f"worker {address} cannot run Marsyard: {identity!r}")
            check_identity(address, identity, identify_code())
            self._checked.add(address)

    def create_queue(self) -> Any:
        """Create an iterator over futures in the order in which they finish."""
        return self._distributed.as_completed(loop=self._client.loop)

    def is_lost_with_workers(self, error: BaseException) -> bool:
        """Whether a batch was lost with several workers in succession."""
        return isinstance(error, self._distributed.scheduler.KilledWorker)


class _BatchQueue:
    """The batches of one piece of work on a cluster: twice as many as there are threads are queued."""

    def __init__(self, cluster: ClusterExecutor, work: Work[Any]) -> None:
        self._cluster, self._work = cluster, work
        self._batches = Batches(work.items, work.total, 1)
        self._repeated: deque[Sequence[int]] = deque()
        self._abandoned: Counter[int] = Counter()
        self._divided: set[int] = set()
        self._futures: dict[Any, Sequence[int]] = {}
        self._completed = cluster.create_queue()
        self._threads, self._executors = 0, 1
        self._refreshed_s = self._with_workers_s = time.monotonic()
        self._refresh()

    def results(self) -> Iterator[list[TaskResult[Any]]]:
        """Yield the results of batches as they finish."""
        self._fill()
        while self._futures:
            future = self._next_future()
            if future is not None:
                batch = self._futures.pop(future)
                results = self._collect(future, batch)
                future.release()
                if results:
                    yield results
            self._fill()

    def cancel(self) -> None:
        """Cancel all queued batches."""
        self._cluster.cancel(list(self._futures))

    def _fill(self) -> None:
        """Submit batches until the queue is full; lost batches first."""
        while len(self._futures) < _QUEUED_BATCHES * max(self._threads, 1):
            batch = self._repeated.popleft() if self._repeated else self._batches.next()
            if not batch:
                return
            future = self._cluster.submit(replace(self._work, items=tuple(batch), total=len(batch)), self._executors)
            self._futures[future] = batch
            self._completed.add(future)

    def _next_future(self) -> Any:
        """Wait for a finished future; None if the number of workers was updated instead."""
        while not self._completed.has_ready():
            if self._cluster.is_connected() and time.monotonic() - self._refreshed_s > _REFRESH_S:
                self._refresh()
                return None
            time.sleep(_POLL_S)
        return next(self._completed)

    def _refresh(self) -> None:
        """Update the number of workers. Raises CampaignError if there are none for a long time."""
        self._refreshed_s = time.monotonic()
        self._threads, self._executors = self._cluster.count_threads()
        self._batches.workers = max(self._threads, 1)
        if self._threads:
            self._with_workers_s = self._refreshed_s
        elif self._refreshed_s - self._with_workers_s > _NO_WORKERS_S:
            raise CampaignError(f"the cluster has had no workers for {_NO_WORKERS_S / 60:.0f} minutes")

    def _collect(self, future: Any, batch: Sequence[int]) -> list[TaskResult[Any]]:
        """Return the results of a batch; empty if it was lost and is queued again.

        Raises CampaignError if the cluster cannot run batches.
        """
        try:
            if future.status == "cancelled":
                raise CancelledError
            # the results are fetched from the worker, which or whose scheduler can be lost at this moment
            seconds, results = future.result(timeout=_TIMEOUT_S)
        except CampaignError:
            raise
        except (CancelledError, OSError, TimeoutError):
            is_abandoned = True
        except Exception as error:
            if not self._cluster.is_lost_with_workers(error):
                raise CampaignError(f"the cluster cannot run a batch: {error!r}; {_ADVICE}") from error
            is_abandoned = False
        else:
            self._batches.record_time(len(batch), seconds)
            return [replace(result, attempts=result.attempts + (result.item in self._divided)) for result in results]
        if is_abandoned and self._count_abandoned(batch) <= _MAX_ABANDONED:
            self._repeated.append(batch)
        elif len(batch) > 1:
            # each of its items may have ended the Dask workers
            self._divided.update(batch)
            self._repeated.extend((item,) for item in batch)
        else:
            return [TaskResult(batch[0], None, WorkerExitError(CRASHED, "its Dask workers died in succession", ""))]
        return []

    def _count_abandoned(self, batch: Sequence[int]) -> int:
        """Count and return how often the cluster has abandoned a batch: its scheduler restarted, for example."""
        self._abandoned.update(batch)
        return max(self._abandoned[item] for item in batch)


def _start_local_cluster(address: str) -> Any:
    """Start a Dask cluster with N workers on this machine, for the address `local:N`."""
    from distributed import LocalCluster

    number = address.removeprefix(_LOCAL_PREFIX)
    if not (number.isdecimal() and int(number) >= 1):
        raise CampaignError(f"--cluster {address}: expected local:N, with N at least 1")
    # the memory limit applies to the worker processes of the cases, not to the Dask workers
    worker_options: dict[str, Any] = {"n_workers": int(number), "threads_per_worker": 1, "processes": True}
    # without a port of its own, Dask's HTTP server takes 8787, and warns if another local cluster already uses it
    scheduler_options = {"dashboard": False, "dashboard_address": ":0"}
    return LocalCluster(**worker_options, scheduler_kwargs=scheduler_options, memory_limit=0, silence_logs="ERROR")


@cache
def identify_code() -> CodeIdentity:
    """Return the identity of the code in this process."""
    return hash_code(()), tuple(sorted(read_versions().items()))


def _run_batch_isolated(
    work: Work[Result], executors: int, identity: CodeIdentity
) -> tuple[float, list[TaskResult[Result]]]:
    """Run a batch in the worker process of this Dask thread; return the duration in seconds and the results.

    identity: that of the program that submits the batch. Raises CampaignError if this worker has another one.
    """
    import distributed

    check_identity(distributed.get_worker().address, identify_code(), identity)
    start_s = time.perf_counter()
    results = [result for batch in _local_executor(executors).run(work) for result in batch]
    return time.perf_counter() - start_s, results


def _local_executor(executor_count: int) -> LocalExecutor:
    """Return the executor of this Dask thread; a new one if more executors share the memory of the machine now."""
    executor: LocalExecutor | None = getattr(_thread_state, "executor", None)
    if executor is not None and executor_count <= _thread_state.executor_count:
        return executor
    if executor is not None:
        executor.stop(kill=False)
    # Dask's workers are daemons of `multiprocessing`, which must not have children. The kernel ends the children
    # together with the thread that started them.
    multiprocessing.process.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
    executor = LocalExecutor(1, executor_count)
    _thread_state.executor, _thread_state.executor_count = executor, executor_count
    return executor
