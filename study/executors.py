"""Where a study's tasks run: in this process, in a pool of processes, or on a Dask cluster.

All three take the same function and yield the same outcomes; only the order differs.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from typing import Any, TypeVar

from ..recording import MarchaError, UsageError
from ..recording.scratch import scratch_folder
from ..recording.threads import LIMIT

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
    LIMIT: "1",
}


#: Environment variable that tells a server whose kernels to load: names of estimators, blanks between.
ESTIMATORS = "MARCHA_STUDY_ESTIMATORS"


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
        self._pool: WarmPool | None = None
        self._client: Any = None
        if scheduler is not None:
            self._client = _connect(scheduler)
            self.processes = max(1, len(self._client.nthreads()))

    def __enter__(self) -> Executor:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(now=kind is not None and not issubclass(kind, Exception))
        if self._client is not None:
            self._client.close()

    def warm_up(self, modules: Iterable[str], estimators: Iterable[str]) -> None:
        """Start the processes without waiting for them; they load these modules and estimators' kernels."""
        if self._client is None and self.processes > 1 and self._pool is None:
            self._pool = WarmPool(self.processes, modules, estimators)

    def run(
        self,
        function: Callable[[T], R],
        tasks: Sequence[T],
        meanwhile: Callable[[], object] = lambda: None,
    ) -> Iterator[Outcome[T, R]]:
        """Run ``function`` on every task and yield (task, result or the exception it raised) as they finish.

        Parameters
        ----------
        function : callable
            Module-level function; function and tasks must be picklable.
        tasks : sequence
            In the order of their start.
        meanwhile : callable, optional
            Called here, once, when others have their first tasks.
        """
        if self._client is not None:
            return _on_cluster(self._client, function, tasks, meanwhile)
        if self.processes == 1 or (len(tasks) < 2 and self._pool is None):
            return _here(function, tasks, meanwhile)
        return self._in_pool(function, tasks, meanwhile)

    def _in_pool(
        self, function: Callable[[T], R], tasks: Sequence[T], meanwhile: Callable[[], object]
    ) -> Iterator[Outcome[T, R]]:
        waiting = deque(tasks)
        running: dict[Future[R], T] = {}
        lost: list[T] = []

        def feed() -> None:
            # Four tasks a worker: none waits for the parent, and a broken pool loses little.
            while waiting and len(running) < 4 * self.processes and not lost:
                if self._pool is None:
                    self._pool = WarmPool(self.processes)
                task = waiting.popleft()
                try:
                    running[self._pool.submit(function, task)] = task
                except BrokenProcessPool:
                    lost.append(task)

        feed()
        meanwhile()
        while running or lost:
            for future in wait(running, return_when=FIRST_COMPLETED).done if running else ():
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
                if self._pool is not None:
                    self._pool.shutdown()
                    self._pool = None
                yield from _one_by_one(function, lost)
                lost.clear()
            feed()


def _here(
    function: Callable[[T], R], tasks: Sequence[T], meanwhile: Callable[[], object]
) -> Iterator[Outcome[T, R]]:
    meanwhile()
    for task in tasks:
        yield task, _attempt(function, task)


def _attempt(function: Callable[[T], R], task: T) -> R | Exception:
    try:
        return function(task)
    except Exception as error:  # one cell's failure must not end the study
        return error


def _start_worker() -> None:
    """Leave Ctrl-C to the parent, unwind at SIGTERM, and end when the parent has ended, in whatever way."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True, name="watch").start()


def _end_with(sentinel: int) -> None:
    from multiprocessing.connection import wait as ready

    ready([sentinel])
    os._exit(1)


def _ready() -> None:
    """Be there."""


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


class WarmPool:
    """Processes that start while this one goes on.

    Parameters
    ----------
    count : int
        How many.
    modules, estimators : iterable of str
        Imported, and their kernels loaded, before there is a task.
    """

    def __init__(self, count: int, modules: Iterable[str] = (), estimators: Iterable[str] = ()) -> None:
        # Not fork: threads of polars and numba do not survive it. A fork server has none of them; it loads
        # once what all workers need, where the system has it.
        served = "forkserver" in multiprocessing.get_all_start_methods()
        context = multiprocessing.get_context("forkserver" if served else "spawn")
        _place_of_sockets()
        self._pool = ProcessPoolExecutor(count, context, initializer=_start_worker)
        self._count = count
        self._own_server = served and _server_pid() is None
        with _environment(SINGLE_THREAD | {ESTIMATORS: " ".join(estimators)}):
            if served:  # its workers inherit this environment
                from multiprocessing import forkserver

                context.set_forkserver_preload([f"{__package__}.preload", *modules])
                forkserver.ensure_running()
            else:
                self._make_workers()
        # A server makes none before it has loaded everything: nobody should wait for that.
        self._started: Future[None] = Future()
        threading.Thread(target=self._start, daemon=True, name="study pool").start()

    def _make_workers(self) -> list[Future[None]]:
        return [self._pool.submit(_ready) for _ in range(self._count)]

    def _start(self) -> None:
        try:
            for future in self._make_workers():
                future.result()
        except BaseException as error:  # raised again where the pool is used
            for process in (self._pool._processes or {}).values():  # the server may have died between two
                process.kill()
            self._started.set_exception(error)
        else:
            self._started.set_result(None)

    def submit(self, function: Callable[..., R], *arguments: Any) -> Future[R]:
        """Have a worker call ``function(*arguments)``; waits until there is one."""
        self._started.result()
        return self._pool.submit(function, *arguments)

    def shutdown(self, now: bool = False) -> None:
        """Wait for the running tasks and end the processes; not for what they are still loading.

        ``now`` gives the running tasks up: they unwind, or are killed after a second.
        """
        if now:
            processes = list((self._pool._processes or {}).values())
            for process in processes:
                process.terminate()
            until = time.monotonic() + 1.0
            for process in processes:
                process.join(max(0.0, until - time.monotonic()))
                process.kill()
        while self._own_server and not self._started.done():
            _stop_server()
            wait([self._started], timeout=0.1)  # a thread that had not asked it yet has started another
        self._started.exception()
        self._pool.shutdown(wait=True, cancel_futures=True)


@cache
def _place_of_sockets() -> None:
    """Let multiprocessing keep its sockets in a folder that the next process removes if this one is killed."""
    from multiprocessing import util

    stack = ExitStack()
    folder, before = stack.enter_context(scratch_folder()), tempfile.tempdir
    tempfile.tempdir = str(folder)
    try:
        util.get_temp_dir()  # it remembers the place
    finally:
        tempfile.tempdir = before
    util.Finalize(None, stack.close, exitpriority=-200)  # behind multiprocessing's own, of -100


def _server() -> Any:
    from multiprocessing import forkserver

    return forkserver._forkserver  # pyright: ignore[reportAttributeAccessIssue]


def _server_pid() -> int | None:
    """Return the process that others are forked from, None where there is none yet."""
    return _server()._forkserver_pid if "multiprocessing.forkserver" in sys.modules else None


def _stop_server() -> None:
    """End the server that processes are forked from, if there is one; the next pool starts another."""
    if _server_pid() is None:
        return
    server = _server()
    with server._lock:  # or another thread could start one that is waited for and was never killed
        if server._forkserver_pid is not None:
            with suppress(ProcessLookupError):
                os.kill(server._forkserver_pid, signal.SIGKILL)
            server._stop_unlocked()  # waits for it: it must not be taken for a living one


def _one_by_one(function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[Outcome[T, R]]:
    """Find out which task kills its worker: each gets a process of its own."""
    for task in tasks:
        pool = WarmPool(1)
        try:
            yield task, pool.submit(_attempt, function, task).result()
        except BrokenProcessPool:
            yield (
                task,
                MarchaError(
                    "the worker process died: out of memory, a crash in compiled code, or a calling script "
                    "without `if __name__ == '__main__':`"
                ),
            )
        finally:
            pool.shutdown()


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


def _on_cluster(
    client: Any, function: Callable[[T], R], tasks: Sequence[T], meanwhile: Callable[[], object]
) -> Iterator[Outcome[T, R]]:
    from dask.distributed import as_completed  # pyright: ignore[reportMissingImports]

    futures = {client.submit(_attempt, function, task, pure=False): task for task in tasks}
    try:
        meanwhile()
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
