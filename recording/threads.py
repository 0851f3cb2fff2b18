"""Helper threads: reading ahead, compressing, hashing beside the main thread."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any, TypeVar

T = TypeVar("T")

LIMIT = "MARCHA_THREADS"
"""Environment variable: most threads that marcha may use for one task; 1 keeps everything in the caller's."""


def threads() -> int:
    """Return how many threads may work at a time: one a core, at most 4, at most :data:`LIMIT`."""
    given = os.environ.get(LIMIT, "")
    most = int(given) if given.isdigit() and int(given) > 0 else 4
    return min(4, most, os.cpu_count() or 1)


def helpers(name: str, most: int = 4) -> Executor:
    """Return an executor for work beside the caller's: threads, or none where only one may work.

    Parameters
    ----------
    name : str
        Names the threads ``marcha-<name>``.
    most : int
        Most threads that this work can use; 0 where it is too little for any.
    """
    if most == 0 or threads() == 1:
        return _Here()
    return ThreadPoolExecutor(min(most, threads()), thread_name_prefix=f"marcha-{name}")


class _Here(Executor):
    """Does everything at once, in the caller's thread."""

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # raised where the result is asked for, as by any executor
            future.set_exception(error)
        return future


def ahead(items: Iterator[T], name: str, depth: int = 1) -> Generator[T, None, None]:
    """Yield the items, the next ``depth`` of them being made in a thread meanwhile; closes ``items``."""
    end: Any = object()
    pool = helpers(name, 1)
    try:
        coming = deque(pool.submit(next, items, end) for _ in range(depth))
        while (item := coming.popleft().result()) is not end:
            coming.append(pool.submit(next, items, end))
            yield item
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        close = getattr(items, "close", None)
        if close is not None:
            close()
