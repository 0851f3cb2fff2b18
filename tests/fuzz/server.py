"""A process for every input: forked from one that has all loaded, with limits of time and memory."""

from __future__ import annotations

import contextlib
import faulthandler
import gc
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
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

CPU_S = 5
"""Processor time of one input; a hang by the clock is six times that, since other work may hold the machine."""
MEMORY_BYTES = 500_000_000
"""What one input may take beside what the process has when it begins."""
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


def scratch() -> Path:
    """Return a new folder, in memory where the system has such a place: inputs are many and short lived."""
    shared = Path("/dev/shm")
    return Path(tempfile.mkdtemp(prefix="marcha-fuzz-", dir=shared if os.access(shared, os.W_OK) else None))


def in_child(
    task: Callable[[], Any], *, cpu_s: float = CPU_S, memory: int = MEMORY_BYTES
) -> tuple[Any, Verdict]:
    """Run ``task`` in a process of its own and return its result and the verdict.

    What is called here must have no threads: they do not live on in a forked process.
    """
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reader)
        _be_child(task, writer, cpu_s, memory)
    os.close(writer)
    data, late = _collect(reader, 6 * cpu_s)
    if late:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(pid, signal.SIGKILL)
    _, status, usage = os.wait4(pid, 0)
    with contextlib.suppress(ProcessLookupError, PermissionError):  # what it started and left running
        os.killpg(pid, signal.SIGKILL)
    used = usage.ru_utime + usage.ru_stime
    if late or (os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU):
        return None, Verdict("hang", f"more than {cpu_s:g} s", used)
    if os.WIFSIGNALED(status):
        name = signal.Signals(os.WTERMSIG(status)).name
        return None, Verdict("crash", f"ended by {name}; {data[-300:].decode(errors='replace')}", used)
    try:
        result, kind, detail, grown = pickle.loads(data)
    except Exception:
        return None, Verdict("crash", f"ended with status {status} and no word", used)
    if not kind and grown > memory:
        kind, detail = "memory", f"{grown / 1e6:.0f} MB"
    return result, Verdict(kind, detail, used)


def _collect(reader: int, limit_s: float) -> tuple[bytes, bool]:
    """Return all that comes out of a pipe, and whether it took too long."""
    until, parts = time.monotonic() + limit_s, []
    try:
        while (left := until - time.monotonic()) > 0:
            if select.select([reader], [], [], left)[0]:
                part = os.read(reader, _PIECE)
                if not part:
                    return b"".join(parts), False
                parts.append(part)
        return b"".join(parts), True
    finally:
        os.close(reader)


def _be_child(task: Callable[[], Any], writer: int, cpu_s: float, memory: int) -> None:
    """Do the task, write what became of it, and end without cleaning up: this process shares all with others."""
    os.setpgid(0, 0)
    faulthandler.disable()  # a crash is told by its signal
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (max(1, int(cpu_s)), int(cpu_s) + 2))
    before = _resident()
    _limit_data(3 * memory)
    result, kind, detail = None, "", ""
    try:
        result = task()
    except Failure as failure:
        kind, detail = failure.kind, failure.detail
    except MemoryError:
        kind, detail = "memory", traceback.format_exc(limit=-3)
    except BaseException:
        kind, detail = "traceback", traceback.format_exc(limit=-6)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
    data = pickle.dumps((result, kind, detail, grown))
    with os.fdopen(writer, "wb") as out:
        out.write(data)
    os._exit(0)


def _resident() -> int:
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _limit_data(more: int) -> None:
    """Let the process take so many bytes more: what takes too much must not take the machine's."""
    try:
        text = Path("/proc/self/status").read_text()
        now = int(text.split("VmData:")[1].split()[0]) * 1024
    except (OSError, IndexError, ValueError):
        return
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_DATA, (now + more, now + more))


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
