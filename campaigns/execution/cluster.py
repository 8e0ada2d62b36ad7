"""Cases on a Dask cluster, as safe as on one machine.

No case runs in a Dask worker's own process. What is sent there is a watcher: it keeps worker processes like those of
one machine, one for each of the Dask worker's threads, and runs its batch in one with the same limits
(`marsyard.campaigns.execution.workers`). A case that hangs, takes the memory or kills its process so costs that process
alone, and its cause is identified as on one machine. Where a Dask worker itself is lost, Dask gives its batches to
others; a batch that lost several (Dask's `allowed-failures`, by default 3) comes back, is cut into single cases, and
only a case that does so again counts as crashed.
"""

from __future__ import annotations

import multiprocessing.process
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from dataclasses import replace
from types import TracebackType
from typing import Any, Self, TypeVar

from marsyard.campaigns.definition.identity import code_hash, package_versions
from marsyard.campaigns.errors import CampaignError
from marsyard.campaigns.execution.batches import Batches
from marsyard.campaigns.execution.work import Work
from marsyard.campaigns.execution.worker_process import Done
from marsyard.campaigns.execution.workers import LocalWorkers
from marsyard.campaigns.outcomes import CRASHED, CaseEndedError

Result = TypeVar("Result")

#: Seconds to wait for a scheduler, and for a first worker.
_REACH_S = 30

#: Batches that each Dask worker has at hand, so that none waits for the network.
_BATCHES_AHEAD = 2

_LOCAL = "local:"

_here = threading.local()


class ClusterWorkers:
    """The workers of a Dask cluster, as a context.

    Parameters
    ----------
    address
        Of a scheduler (`tcp://host:8786`), or `local:N` for a cluster of N workers on this machine.

    Raises
    ------
    CampaignError
        Where Dask is missing, there is no such cluster, or its workers run other code than this program.
    """

    def __init__(self, address: str) -> None:
        try:
            import distributed
        except ImportError as error:
            raise CampaignError("a cluster needs Dask: pip install 'marsyard[dask]'") from error
        self._distributed = distributed
        self._cluster: Any = _local_cluster(address) if address.startswith(_LOCAL) else None
        try:
            if self._cluster is None:
                # Dask never closes a client that fails over its address. Garbage collection does, and where that comes
                # upon it in the thread of the next client, both wait for each other for 10 s and fail.
                distributed.comm.get_address_host_port(address)
            self._client = distributed.Client(self._cluster or address, timeout=_REACH_S, set_as_default=False)
        except (OSError, ValueError, ImportError) as error:
            raise CampaignError(f"--cluster {address}: no scheduler answers: {error}") from error
        try:
            self._client.wait_for_workers(1, timeout=_REACH_S)
            self._check_code()
        except TimeoutError as error:
            self._close()
            raise CampaignError(f"--cluster {address}: the scheduler has no workers") from error
        except BaseException:
            self._close()
            raise

    def _check_code(self) -> None:
        """Refuses workers whose rows would be others."""
        own = code_hash(""), package_versions()
        for worker, (code, versions) in self._client.run(_code_and_versions).items():
            if code != own[0]:
                raise CampaignError(f"worker {worker} has other code of Marsyard than this program")
            differing = sorted(name for name in own[1] if own[1][name] != versions.get(name))
            if differing:
                stated = ", ".join(f"{name} {versions.get(name)} (here {own[1][name]})" for name in differing)
                raise CampaignError(f"worker {worker} has other versions: {stated}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def _close(self) -> None:
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()

    def run(self, work: Work[Result]) -> Iterator[list[Done[Result]]]:
        """See `Workers.run`."""
        threads = sum(self._client.nthreads().values())
        sharers = self._threads_of_the_fullest_machine()
        batches = Batches(work.items, work.total, threads)
        coming = self._distributed.as_completed(loop=self._client.loop)
        sent: dict[Any, Sequence[int]] = {}

        def send(batch: Sequence[int]) -> None:
            future = self._client.submit(
                _watch_batch, replace(work, items=tuple(batch), total=len(batch)), sharers, pure=False
            )
            sent[future] = batch
            coming.add(future)

        def send_next() -> None:
            if batch := batches.next():
                send(batch)

        try:
            for _ in range(_BATCHES_AHEAD * threads):
                send_next()
            while sent:
                future = next(coming)
                batch = sent.pop(future)
                done = self._ended(future, batch, batches)
                if done is None:
                    for item in batch:
                        send((item,))
                else:
                    send_next()
                future.release()
                if done:
                    yield done
        finally:
            self._client.cancel(list(sent))

    def _threads_of_the_fullest_machine(self) -> int:
        """Among how many watchers the memory of a machine is shared."""
        found: Counter[str] = Counter()
        for worker in self._client.scheduler_info(n_workers=-1)["workers"].values():
            found[worker["host"]] += worker["nthreads"]
        return max(found.values(), default=1)

    def _ended(self, future: Any, batch: Sequence[int], batches: Batches) -> list[Done[Any]] | None:
        """What became of a batch; None where it was lost with its workers and its cases must be sent one by one."""
        error = future.exception() if future.status != "cancelled" else CancelledError("the cluster gave it up")
        if error is None:
            seconds, done = future.result()
            batches.took(len(batch), seconds)
            return list(done)
        if isinstance(error, CampaignError):
            raise error
        if len(batch) > 1:
            return None
        lost = isinstance(error, (self._distributed.scheduler.KilledWorker, CancelledError))
        known = CaseEndedError(CRASHED, "its Dask workers died one after another", "") if lost else error
        return [Done(batch[0], None, known if isinstance(known, Exception) else RuntimeError(repr(known)))]


def _local_cluster(address: str) -> Any:
    """A cluster of so many workers on this machine."""
    from distributed import LocalCluster

    number = address.removeprefix(_LOCAL)
    if not (number.isdecimal() and int(number) >= 1):
        raise CampaignError(f"--cluster {address}: expected local:N, with N at least 1")
    return LocalCluster(
        n_workers=int(number),
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
        # of the watchers, which hold next to nothing; that of cases is limited by the watchers
        memory_limit=0,
        silence_logs="ERROR",
    )


def _code_and_versions() -> tuple[str, dict[str, str]]:
    return code_hash(""), package_versions()


def _watch_batch(work: Work[Result], sharers: int) -> tuple[float, list[Done[Result]]]:
    """Runs a batch beside a Dask worker, in a process that belongs to the thread that this is called in."""
    began = time.perf_counter()
    done = [one for ended in _own_workers(sharers).run(work) for one in ended]
    return time.perf_counter() - began, done


def _own_workers(sharers: int) -> LocalWorkers:
    """The worker process of this thread."""
    workers: LocalWorkers | None = getattr(_here, "workers", None)
    if workers is None:
        # Dask's workers are daemons to `multiprocessing`, which may have no children, as those would be left over. Ours
        # are not: the kernel ends them with the thread that started them.
        multiprocessing.process.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
        workers = _here.workers = LocalWorkers(1, sharers)
    return workers
