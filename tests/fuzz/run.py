"""Many inputs, shared among processes; what failed, by kind and place, with what reproduces it."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import numpy as np

from .mutators import Rng
from .seeds import Seeds
from .server import Verdict, emptied, in_child, load, loaded, scratch, together

if TYPE_CHECKING:
    from .targets import Target

WARM = 4
"""Most inputs of each target that run before all others, so that what they need is loaded once."""

TOGETHER = 256
"""Inputs of one target that run in one process, which loads what draws (a second) anew."""


@dataclass
class Failed:
    """Failures of one kind at one place: the first input that shows it, and how many do."""

    target: str
    number: int
    verdict: Verdict
    count: int = 1


@dataclass
class Result:
    """What a run found."""

    inputs: int = 0
    seconds: float = 0.0
    cpu_s: float = 0.0
    failed: dict[str, Failed] = field(default_factory=dict)
    by_target: dict[str, list[float]] = field(default_factory=dict)

    @property
    def failures(self) -> int:
        """How many inputs failed."""
        return sum(f.count for f in self.failed.values())

    def add(self, target: str, number: int, verdict: Verdict) -> None:
        """Count one input."""
        self.inputs += 1
        tally = self.by_target.setdefault(target, [0, 0.0])
        tally[0] += 1
        tally[1] += verdict.cpu_s
        if verdict.kind:
            place = f"{verdict.kind} {_place(verdict.detail)}"
            if place in self.failed:
                self.failed[place].count += 1
            else:
                self.failed[place] = Failed(target, number, verdict)

    def merge(self, other: Result) -> None:
        """Add what another process found."""
        self.inputs += other.inputs
        self.cpu_s += other.cpu_s
        for target, (count, used) in other.by_target.items():
            tally = self.by_target.setdefault(target, [0, 0.0])
            tally[0] += count
            tally[1] += used
        for place, found in other.failed.items():
            if place in self.failed:
                self.failed[place].count += found.count
            else:
                self.failed[place] = found


def _place(detail: str) -> str:
    """Return the last place of a traceback, or the detail without what differs from input to input."""
    places = re.findall(r'File "[^"]*?([^/"]+/[^/"]+)", line (\d+)', detail)
    last = detail.strip().splitlines()[-1] if detail.strip() else ""
    said = re.sub(r"0x[0-9a-f]+|\d+(\.\d+)?|'[^']*'|/\S+", "…", last)[:80]
    return f"{places[-1][0]}:{places[-1][1]} {said}" if places else said


def generator(seed: int, target: str, number: int) -> Rng:
    """Return the random generator of one input."""
    return np.random.default_rng([seed, *target.encode(), number])


def prepare(place: Path, warm_inputs: int = WARM) -> Seeds:
    """Make the sound inputs in a process of its own, and load here what that process had loaded."""

    def warm() -> object:
        from . import seeds, targets

        sound = seeds.make(place / "seeds")
        with emptied(place) as folder:
            targets.warm(sound, folder)
        for target in {t.name: t for t in targets.targets(sound)}.values():
            for number in range(warm_inputs):
                with emptied(place) as folder, contextlib.suppress(BaseException):
                    target.run(generator(0, target.name, number), folder)
        return sound, *loaded()

    result, verdict = in_child(warm, cpu_s=600, memory=4 << 30)
    if result is None or verdict.kind:
        raise RuntimeError(f"the sound inputs cannot be made: {verdict.kind} {verdict.detail}")
    made, modules, kernels = result
    shutil.rmtree(place / "seeds", ignore_errors=True)
    load(modules, kernels)
    return made


def in_turn(known: Sequence[Target]) -> list[Target]:
    """Return the targets in the order of their inputs: all once, then the cheaper ones again and again."""
    return [t for k in range(max(t.turns for t in known)) for t in known if k < t.turns]


def run(
    inputs: int,
    *,
    seed: int = 1,
    jobs: int = 1,
    only: str = "",
    first: int = 0,
    keep: Path | None = None,
    log: Path | None = None,
) -> Result:
    """Run so many inputs and return what failed.

    Parameters
    ----------
    inputs : int
        How many, in turn over all targets.
    seed : int
        Another seed gives other inputs.
    jobs : int
        Processes that fork.
    only : str
        Run only targets whose name has this.
    first : int
        Number of the first input.
    keep : Path, optional
        Folder for the first input of every failure.
    log : Path, optional
        File that gets a line for every failure as it is found, and for every thousand inputs.
    """
    began = time.monotonic()
    with scratch() as place:
        sound = prepare(place, min(WARM, 1 + inputs // 1000))
        chosen = in_turn(_chosen(sound, only))
        result = Result()
        if jobs == 1:
            result = _share(chosen, place, range(first, first + inputs), seed, keep, log)
        else:
            for part in _shared(chosen, place, inputs, seed, jobs, first, keep, log):
                result.merge(part)
    result.seconds = time.monotonic() - began
    return result


def _shared(
    chosen: Sequence[Target],
    place: Path,
    inputs: int,
    seed: int,
    jobs: int,
    first: int,
    keep: Path | None,
    log: Path | None,
) -> list[Result]:
    """Divide the inputs among processes that are forked from this one."""
    import pickle

    pipes = []
    for job in range(jobs):
        reader, writer = os.pipe()
        if os.fork() == 0:
            os.close(reader)
            own = place / f"job{job}"
            own.mkdir()
            part = _share(chosen, own, range(first + job, first + inputs, jobs), seed, keep, log)
            with os.fdopen(writer, "wb") as out:
                pickle.dump(part, out)
            os._exit(0)
        os.close(writer)
        pipes.append(reader)
    parts = []
    for reader in pipes:
        with os.fdopen(reader, "rb") as part:
            parts.append(pickle.load(part))
    for _ in pipes:
        os.wait()
    return parts


def _chosen(sound: Seeds, only: str) -> list[Target]:
    """Return the targets whose name has ``only``; the one that has it as its name before others."""
    from .targets import targets

    known = targets(sound)
    chosen = [t for t in known if only == t.name] or [t for t in known if only in t.name]
    if not chosen:
        raise SystemExit(f"no target has {only!r} in its name")
    return chosen


def _share(
    chosen: Sequence[Target],
    place: Path,
    numbers: Sequence[int],
    seed: int,
    keep: Path | None,
    log: Path | None,
) -> Result:
    result, began = Result(), sum(os.times()[:4])
    run_all(result, chosen, numbers, place, seed=seed, keep=keep, log=log)
    result.cpu_s = sum(os.times()[:4]) - began
    return result


def run_all(
    result: Result,
    chosen: Sequence[Target],
    numbers: Sequence[int],
    place: Path,
    *,
    seed: int,
    keep: Path | None = None,
    log: Path | None = None,
) -> None:
    """Run inputs of the chosen targets, a few in one process, and add what became of them to ``result``."""
    thousands = 0
    for target, todo in _in_groups(chosen, numbers):

        def once(number: int, target: Target = target) -> None:
            with emptied(place) as folder:
                target.run(generator(seed, target.name, number), folder)

        while todo:
            went_well, why = together([partial(once, number) for number in todo])
            for number, cpu_s in zip(todo, went_well, strict=False):
                result.add(target.name, number, Verdict(cpu_s=cpu_s))
            if len(went_well) < len(todo):
                _alone(result, target, todo[len(went_well)], why, place, seed, keep, log)
            todo = todo[len(went_well) + 1 :]
        if result.inputs // 1000 > thousands:
            thousands = result.inputs // 1000
            _say(log, {"inputs": result.inputs, "failures": result.failures})


def _in_groups(chosen: Sequence[Target], numbers: Sequence[int]) -> Iterator[tuple[Target, list[int]]]:
    """Give the numbers of inputs, a few of one target at a time; a number always has the same target."""
    waiting: dict[str, list[int]] = {}
    named = {t.name: t for t in chosen}
    for number in numbers:
        name = chosen[number % len(chosen)].name
        group = waiting.setdefault(name, [])
        group.append(number)
        if len(group) == TOGETHER:
            yield named[name], waiting.pop(name)
    for name, group in waiting.items():
        yield named[name], group


def _alone(
    result: Result,
    target: Target,
    number: int,
    said: str,
    place: Path,
    seed: int,
    keep: Path | None,
    log: Path | None,
) -> None:
    """Run again, in a process of its own, an input with which not all went well: ``said`` is how."""
    with emptied(place) as folder:
        _, verdict = in_child(lambda: target.run(generator(seed, target.name, number), folder))
        if not verdict.kind:
            verdict = Verdict("only after others", f"of {target.name}: {said}", verdict.cpu_s)
        new = f"{verdict.kind} {_place(verdict.detail)}" not in result.failed
        result.add(target.name, number, verdict)
        if new:
            about = {"kind": verdict.kind, "detail": verdict.detail}
            _say(log, {"target": target.name, "number": number, "seed": seed, **about})
            if keep is not None:
                shutil.copytree(folder, keep / f"{seed}-{number}", dirs_exist_ok=True)


def _say(log: Path | None, what: dict[str, object]) -> None:
    if log is not None:
        with log.open("a", encoding="utf-8") as out:
            out.write(json.dumps(what) + "\n")


def report(result: Result, seed: int, *, file: TextIO | None = None) -> None:
    """Print what a run found."""
    out = sys.stdout if file is None else file
    for place, found in sorted(result.failed.items(), key=lambda f: -f[1].count):
        print(
            f"\n{found.count} × {place}\n  --only {found.target!r} --seed {seed} --first {found.number}",
            file=out,
        )
        print("  " + found.verdict.detail.strip()[-1500:].replace("\n", "\n  "), file=out)
    print(
        f"\n{result.inputs} inputs in {result.seconds:.0f} s ({result.cpu_s / 3600:.2f} h of processor, "
        f"{1e3 * result.cpu_s / max(1, result.inputs):.0f} ms each), "
        f"{result.failures} failures of {len(result.failed)} kinds",
        file=out,
    )
