"""Helper threads: reading ahead, compressing, hashing beside the main thread."""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextvars import copy_context
from typing import Any, TypeVar

T = TypeVar("T")

LIMIT = "MARCHA_THREADS"
"""Environment variable: most threads that marcha may use for one task; 1 keeps everything in the caller's."""


def threads() -> int:
    """Return how many threads may work at a time: one a core, at most 4, at most :data:`LIMIT`."""
    stated = os.environ.get(LIMIT, "")
    most = int(stated) if stated.isdigit() and int(stated) > 0 else 4
    return min(4, most, os.cpu_count() or 1)


def give_back_memory() -> None:
    """Hand freed memory to the system where the C library keeps it: a thread's share of it may be large."""
    with contextlib.suppress(AttributeError, OSError, ValueError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)  # glibc has it, others give back by themselves


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
        return _InlineExecutor()
    return _Pool(min(most, threads()), thread_name_prefix=f"marcha-{name}")


class _Pool(ThreadPoolExecutor):
    """Does everything in the caller's context: what it says of NumPy's warnings holds in the threads too."""

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        return super().submit(copy_context().run, fn, *args, **kwargs)


class _InlineExecutor(Executor):
    """Does everything at once, in the caller's thread."""

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # raised where the result is asked for, as by any executor
            future.set_exception(error)
        return future


class Prefetch(Iterator[T]):
    """Items that a thread makes before they are asked for; from now on, not from the first on.

    Parameters
    ----------
    items : iterator
        Closed at the end, or by :meth:`close`.
    name : str
        Names the thread.
    depth : int
        Items that may wait.
    """

    def __init__(self, items: Iterator[T], name: str, depth: int = 1) -> None:
        self._items = items
        self._pool = helpers(name, 1)
        self._coming = deque(self._pool.submit(next, items, _END) for _ in range(depth))

    def __next__(self) -> T:
        if self._coming:
            try:
                item = self._coming.popleft().result()
            except BaseException:
                self.close()
                raise
            if item is not _END:
                self._coming.append(self._pool.submit(next, self._items, _END))
                return item
        self.close()
        raise StopIteration

    def close(self) -> None:
        """Wait for the item being made, and make no more."""
        self._coming.clear()
        self._pool.shutdown(wait=True, cancel_futures=True)
        close = getattr(self._items, "close", None)
        if close is not None:
            close()


_END: Any = object()
