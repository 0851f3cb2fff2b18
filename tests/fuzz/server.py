"""Processes for inputs: forked from one that has all loaded, with limits of time and memory.

Inputs run a few to a process, since a fresh one spends more on copying pages than on the input; one after which
not all is well runs again in a process of its own, and that one's verdict counts.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import io
import os
import pickle
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from marcha.recording.scratch import remove_left

CPU_S = 5
"""Processor time of one input; a hang by the clock is six times that, since other work may hold the machine."""
MEMORY_BYTES = 500_000_000
"""What one input may take beside what the process has when that input begins."""
THREADED = ("rerun", "marcha.viz", "marcha.study", "__main__", "__mp_")
"""Modules that start threads when they are imported, which do not live on in a forked process, or that use those."""
_REGISTRIES = (
    "marcha.ingest.registry:importers",
    "marcha.export:available",
    "marcha.recording.provenance:environment",
)
"""What a process asks once."""
_PIECE = 1 << 20


class Failure(Exception):
    """An input that did what none may do: ``kind`` and what happened."""

    def __init__(self, kind: str, detail: str) -> None:
        super().__init__(f"{kind}: {detail}")
        self.kind, self.detail = kind, detail


@dataclass(frozen=True)
class Verdict:
    """What became of one input: ``kind`` is empty where all is well."""

    kind: str = ""
    detail: str = ""
    cpu_s: float = 0.0


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """Give a folder, in memory where the system has such a place; what a killed fuzzer left there is removed."""
    shared = Path("/dev/shm")
    place = shared if os.access(shared, os.W_OK) else Path(tempfile.gettempdir())
    remove_left(place)
    folder = Path(tempfile.mkdtemp(prefix=f"marcha-{os.getpid()}-fuzz-", dir=place))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def in_child(
    task: Callable[[], Any], *, cpu_s: float = CPU_S, memory: int = MEMORY_BYTES
) -> tuple[Any, Verdict]:
    """Run ``task`` in a process of its own and return its result and the verdict.

    What is called here must have no threads: they do not live on in a forked process.
    """
    data, late, status, used = _forked([task], cpu_s, memory)
    if late or (os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU):
        return None, Verdict("hang", f"more than {cpu_s:g} s", used)
    if os.WIFSIGNALED(status):
        name = signal.Signals(os.WTERMSIG(status)).name
        return None, Verdict("crash", f"ended by {name}; {data[-300:].decode(errors='replace')}", used)
    words = _words(data)
    if not words:
        return None, Verdict("crash", f"ended with status {status} and no word", used)
    return words[0].result, Verdict(words[0].kind, words[0].detail, used)


def together(tasks: Sequence[Callable[[], Any]]) -> tuple[list[float], str]:
    """Run tasks one after another in one process, up to the first that does not go well.

    Returns
    -------
    list of float
        Processor time (s) of each task that went well; where they are fewer than the tasks, the next did not.
    str
        What is known of that one.
    """
    data, late, status, _ = _forked(tasks, CPU_S, MEMORY_BYTES)
    words = _words(data)
    said = [f"{word.kind} {word.detail[-800:]}" for word in words if word.kind]
    return [w.cpu_s for w in words if not w.kind], said[0] if said else f"late {late}, status {status}"


class _Word(NamedTuple):
    """What a process says of one task."""

    result: Any
    kind: str
    detail: str
    cpu_s: float


def _words(data: bytes) -> list[_Word]:
    """Return what a process said before it ended."""
    found, stream = [], io.BytesIO(data)
    with contextlib.suppress(Exception):  # the last may be cut short, or be none
        while True:
            found.append(_Word(*pickle.load(stream)))
    return found


def _forked(tasks: Sequence[Callable[[], Any]], cpu_s: float, memory: int) -> tuple[bytes, bool, int, float]:
    """Run tasks in one process; return what it said, whether it was late, its status and processor time (s)."""
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reader)
        _be_child(tasks, writer, cpu_s, memory)
    os.close(writer)
    data, late = _collect(reader, 6 * cpu_s)
    if late:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(pid, signal.SIGKILL)
    _, status, usage = os.wait4(pid, 0)
    with contextlib.suppress(ProcessLookupError, PermissionError):  # what it started and left running
        os.killpg(pid, signal.SIGKILL)
    return data, late, status, usage.ru_utime + usage.ru_stime


def _collect(reader: int, limit_s: float) -> tuple[bytes, bool]:
    """Return all that comes out of a pipe, and whether a task took too long."""
    until, parts = time.monotonic() + limit_s, []
    try:
        while (left := until - time.monotonic()) > 0:
            if select.select([reader], [], [], left)[0]:
                part = os.read(reader, _PIECE)
                if not part:
                    return b"".join(parts), False
                parts.append(part)
                until = time.monotonic() + limit_s
        return b"".join(parts), True
    finally:
        os.close(reader)


def _be_child(tasks: Sequence[Callable[[], Any]], writer: int, cpu_s: float, memory: int) -> None:
    """Do the tasks, write what became of each, and end without cleaning up: all is shared with others."""
    os.setpgid(0, 0)
    faulthandler.disable()  # a crash is told by its signal
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with os.fdopen(writer, "wb") as out:
        for task in tasks:
            # From here on, for each: what those before it loaded and kept is not what this one takes.
            before = _begin_memory(3 * memory)
            began = time.process_time()
            restart_clock(cpu_s)
            result, kind, detail = None, "", ""
            try:
                result = task()
            except Failure as failure:
                kind, detail = failure.kind, failure.detail
            except MemoryError:
                kind, detail = "memory", traceback.format_exc(limit=-3)
            except BaseException:
                kind, detail = "traceback", traceback.format_exc(limit=-6)
            grown = _peak() - before
            if not kind and grown > memory:
                kind, detail = "memory", f"{grown / 1e6:.0f} MB"
            pickle.dump(_Word(result, kind, detail, time.process_time() - began)[:], out)
            out.flush()
            if kind:
                break
    os._exit(0)


def restart_clock(cpu_s: float = CPU_S) -> None:
    """Let the process take so much processor time more: what it loads at first use is no work of an input."""
    until = int(time.process_time()) + max(1, int(cpu_s))
    resource.setrlimit(resource.RLIMIT_CPU, (until, resource.RLIM_INFINITY))


def _begin_memory(more: int) -> int:
    """Forget the peak of before, let the process take so many bytes more, and return what it has now.

    What takes too much must not take the machine's memory.
    """
    try:
        Path("/proc/self/clear_refs").write_text("5")
        data = _status("VmData") + more
    except (OSError, IndexError, ValueError):
        return _peak()
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_DATA, (data, resource.RLIM_INFINITY))
    return _peak()


def _peak() -> int:
    """Return the most bytes that were resident since the peak was forgotten, or ever where it cannot be."""
    try:
        return _status("VmHWM")
    except (OSError, IndexError, ValueError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _status(name: str) -> int:
    return int(Path("/proc/self/status").read_text().split(f"{name}:")[1].split()[0]) * 1024


# -- loading once ------------------------------------------------------------------------------------------


def loaded() -> tuple[list[str], list[tuple[str, str, Any]]]:
    """Return what this process has loaded: modules, and the compiled kernels of marcha with their types."""
    from numba.core.registry import CPUDispatcher

    kernels = []
    for name, module in list(sys.modules.items()):
        if name.startswith("marcha."):
            kernels += [
                (name, key, value.signatures)
                for key, value in list(vars(module).items())
                if isinstance(value, CPUDispatcher) and value.__module__ == name and value.signatures
            ]
    return sorted(sys.modules), kernels


def load(modules: list[str], kernels: list[tuple[str, str, Any]]) -> None:
    """Load what another process had loaded; starts no thread, as the work itself would."""
    for name in modules:
        if not name.startswith(THREADED):
            with contextlib.suppress(Exception):
                import_module(name)
    for module, name, signatures in kernels:
        for signature in signatures:
            with contextlib.suppress(Exception):
                getattr(sys.modules[module], name).compile(signature)
    for registry in _REGISTRIES:
        module, _, name = registry.partition(":")
        getattr(import_module(module), name)()
    gc.collect()
    gc.disable()  # a search would copy every page that the processes share
    gc.freeze()


@contextlib.contextmanager
def emptied(folder: Path) -> Any:
    """Give a fresh folder inside ``folder`` and remove it afterwards, whatever its names."""
    place = folder / "input"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)
