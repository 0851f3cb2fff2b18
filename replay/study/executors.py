"""Where a study's tasks run: in this process, in a pool of processes, or on a Dask cluster.

All three take the same function and yield the same outcomes; only the order differs.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, TypeVar

from ...recording import MarchaError, UsageError

T = TypeVar("T")
R = TypeVar("R")
Outcome = tuple[T, R | Exception]

#: One process per core, one thread per process: libraries must not each start threads for all cores.
SINGLE_THREAD = {
    "POLARS_MAX_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Executor:
    """Runs functions on many tasks; a context manager, since processes and connections must be closed.

    Parameters
    ----------
    workers : int, optional
        Processes; by default one a core. 1 runs everything in this process.
    scheduler : str, optional
        Address of a Dask scheduler (``tcp://host:8786``) to use instead of a pool.

    Raises
    ------
    UsageError
        For a scheduler that cannot be reached, without the ``cluster`` extra, or with ``workers`` as well.
    """

    def __init__(self, workers: int | None = None, scheduler: str | None = None) -> None:
        if workers is not None and workers < 1:
            raise UsageError(f"workers={workers}: at least 1")
        if scheduler is not None and workers is not None:
            raise UsageError("give either workers or a scheduler: a Dask cluster has workers of its own")
        self.processes = cores() if workers is None else workers
        self._pool: ProcessPoolExecutor | None = None
        self._client: Any = None
        if scheduler is not None:
            self._client = _connect(scheduler)
            self.processes = max(1, len(self._client.nthreads()))

    def __enter__(self) -> Executor:
        return self

    def __exit__(self, *error: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
        if self._client is not None:
            self._client.close()

    def run(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Outcome[T, R]]:
        """Run ``function`` on every task and yield (task, result or the exception it raised) as they finish.

        Parameters
        ----------
        function : callable
            Module-level function; function and tasks must be picklable.
        tasks : sequence
            Where a pool has to be started, the first task runs here meanwhile, and fills numba's caches on
            disk once for all workers: it should be a cheap one.
        """
        if self._client is not None:
            return _on_cluster(self._client, function, tasks)
        if self.processes == 1 or (len(tasks) < 2 and self._pool is None):
            return ((task, _attempt(function, task)) for task in tasks)
        return self._in_pool(function, tasks)

    def _in_pool(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Outcome[T, R]]:
        waiting = list(reversed(tasks))
        running: dict[Future[R], T] = {}
        lost: list[T] = []
        pool = self._pool
        if pool is None:
            pool = self._pool = _start(self.processes)
            first = waiting.pop()
            yield first, _attempt(function, first)
        while waiting or running:
            # Four tasks a worker: none waits for the parent, and a broken pool loses little.
            while waiting and len(running) < 4 * self.processes and not lost:
                try:
                    running[pool.submit(function, waiting[-1])] = waiting[-1]
                except BrokenProcessPool:
                    lost.append(waiting[-1])
                waiting.pop()
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                task = running.pop(future)
                error = future.exception()
                if isinstance(error, BrokenProcessPool):
                    lost.append(task)
                elif error is None:
                    yield task, future.result()
                elif isinstance(error, Exception):
                    yield task, error
                else:
                    raise error
            if lost and not running:
                pool.shutdown()
                yield from _one_by_one(function, lost)
                lost = []
                self._pool = None
                if waiting:
                    pool = self._pool = _start(self.processes)


def _attempt(function: Callable[[T], R], task: T) -> R | Exception:
    try:
        return function(task)
    except Exception as error:  # one cell's failure must not end the study
        return error


def _start_worker() -> None:
    """Leave Ctrl-C to the parent, which lets running tasks end and keeps their results."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


#: What workers need: imported once, by the server that they are forked from.
PRELOAD = ["marcha.replay.study.cells", "marcha.replay.study.figures", "marcha.ingest.simulate"]


def _ready() -> None:
    """Make a worker start, and import what the tasks need, before there is one for it."""
    from . import cells  # noqa: F401


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    old = {k: os.environ.get(k) for k in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for key, value in old.items():
            if value is None:
                os.environ.pop(key, None)
            else:
                os.environ[key] = value


def _start(count: int) -> ProcessPoolExecutor:
    import multiprocessing

    # Not fork: threads of polars and numba do not survive it. A fork server has none of them; it imports
    # once what all workers need, where the system has it.
    methods = multiprocessing.get_all_start_methods()
    context = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
    context.set_forkserver_preload(PRELOAD)
    pool = ProcessPoolExecutor(count, context, initializer=_start_worker)
    with _environment(SINGLE_THREAD):  # read when the server or a worker starts, which submit does
        for _ in range(count):
            pool.submit(_ready)
    return pool


def _one_by_one(function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Outcome[T, R]]:
    """Find out which task kills its worker: each gets a process of its own."""
    for task in tasks:
        with _start(1) as pool:
            try:
                yield task, pool.submit(_attempt, function, task).result()
            except BrokenProcessPool:
                yield (
                    task,
                    MarchaError(
                        "the worker process died: out of memory, a crash in compiled code, or a calling "
                        "script "
                        "without `if __name__ == '__main__':`"
                    ),
                )


def _connect(address: str) -> Any:
    try:
        from dask import distributed  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise UsageError(
            f"{address}: a Dask scheduler needs the extra `cluster`; pip install 'marcha[cluster]'"
        ) from None
    try:
        return distributed.Client(address, timeout="10s", set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UsageError(f"{address}: no Dask scheduler answers ({reason}); start `dask scheduler`") from None


def _on_cluster(client: Any, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Outcome[T, R]]:
    from dask.distributed import as_completed  # pyright: ignore[reportMissingImports]

    futures = {client.submit(_attempt, function, task, pure=False): task for task in tasks}
    try:
        for future in as_completed(list(futures), loop=client.loop):
            task = futures.pop(future)
            error = future.exception()
            if error is None:
                yield task, future.result()
            else:  # the cluster itself gave up on it: worker killed, function not importable there
                yield task, error if isinstance(error, Exception) else MarchaError(repr(error))
            future.release()
    finally:
        client.cancel(list(futures))
