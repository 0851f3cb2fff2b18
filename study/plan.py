"""From a configuration to tasks: which recordings there are, which cells they need, and what names a cell.

A cell's key is a hash of everything that its result depends on: the recording's content, how it is converted,
the inputs, the estimator with its parameters, and the code. Cells with a known key are never run again.
"""

from __future__ import annotations

import glob
import hashlib
import inspect
import random
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec

from ..algorithms import available, make
from ..algorithms.contract import AlgorithmError
from ..recording import UsageError
from ..recording.files import files_below
from . import config as cfg
from .withheld import Withheld


class StudyRecording(msgspec.Struct, frozen=True):
    """One recording of the study.

    Attributes
    ----------
    name : str
        Name in tables: the path below the data folder without suffix, or scenario, configuration and number.
    kind : str
        ``mcap``, ``raw`` or ``simulated``.
    digest : str
        Hash of the content and of what it is made with.
    path : str
        File; empty for a simulated walk.
    format : str or None
        Importer of a raw file.
    options : dict
        Options of the importer or of the simulator.
    truth : dict
        What the study knows of the walk.
    scenario, seed : str, int
        What to simulate.
    configuration : str
        Configuration of a simulated walk, with the scenario before it where there are several; empty where
        the study's rules decide.
    size : int
        Bytes, for ordering.
    survey : str
        File of a survey of its route; empty for none.
    """

    name: str
    kind: str
    digest: str
    path: str = ""
    format: str | None = None
    options: dict[str, Any] = {}
    truth: dict[str, Any] = {}
    scenario: str = ""
    seed: int = 0
    configuration: str = ""
    size: int = 0
    survey: str = ""


class Job(msgspec.Struct, frozen=True):
    """One method on one recording: as many cells as inputs.

    Attributes
    ----------
    key : str
        Hash of all that the result depends on.
    method : Method
        What runs.
    """

    key: str
    method: cfg.Method


class StudyTask(msgspec.Struct, frozen=True):
    """What one worker does at a time: jobs on one recording, which is read once for all of them.

    Attributes
    ----------
    name : str
        Hash of the jobs' keys, name of the task's file.
    source : StudyRecording
        The recording.
    jobs : list of Job
        What runs on it; empty to only convert it.
    inputs : list of str
        Globs of topics.
    folder : str
        Where converted and simulated recordings are kept.
    by : str
        Tier by whose labels is measured as well.
    withhold : list of Withheld
        What the estimators do not get.
    """

    name: str
    source: StudyRecording
    jobs: list[Job]
    inputs: list[str]
    folder: str
    by: str = ""
    withhold: list[Withheld] = []


def digest(*parts: Any) -> str:
    """Return a short hash of structures that msgspec can encode; the order of keys does not matter."""
    data = msgspec.json.encode(parts, order="deterministic")
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def file_digest(path: Path) -> str:
    """Return the BLAKE2b hash of a file's, or a folder's files', names and content."""
    total = hashlib.blake2b(digest_size=16)
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    for file in files:
        if path.is_dir():
            total.update(str(file.relative_to(path)).encode())
        with file.open("rb") as handle:
            total.update(hashlib.file_digest(handle, lambda: hashlib.blake2b(digest_size=16)).digest())
    return total.hexdigest()


def code_digest(estimators: Iterable[str]) -> str:
    """Return a hash of the code that results depend on: marcha's packages and version, plug-ins' modules."""
    root = Path(__file__).parents[2]
    files = [p for package in ("recording", "ingest", "algorithms") for p in (root / package).rglob("*.py")]
    files += (root / "replay").glob("*.py")
    files.append(Path(__file__).with_name("cells.py"))
    classes = available()
    for name in sorted(set(estimators)):
        if name not in classes:
            raise UsageError(
                f"{name}: no such estimator; `marcha estimators` lists {', '.join(sorted(classes))}"
            )
        source = inspect.getsourcefile(sys.modules[classes[name].__module__])
        if source is not None and not Path(source).resolve().is_relative_to(root):
            files.append(Path(source))
    total = hashlib.blake2b(metadata.version("marcha").encode(), digest_size=16)
    for file in sorted(files):
        total.update(file.name.encode() + b"\0" + file.read_bytes())
    return total.hexdigest()


def find_sources(
    config: cfg.StudyConfig, data: Path | Sequence[Path] | None, code: str
) -> tuple[list[StudyRecording], list[str]]:
    """Return the study's recordings in the order of their names, and remarks about what was left out.

    Raises
    ------
    UsageError
        For a missing data folder or globs that match nothing.
    """
    sources: list[StudyRecording] = []
    notes: list[str] = []
    if config.recordings is not None:
        files, notes = _files(config.recordings, data)
        surveys = {path.parent / rule.survey for _, path in files for rule in config.recordings.truth}
        for name, path in files:
            if path in surveys:
                continue  # beside the walks, and none itself
            sources.append(_source(config.recordings, name, path, code))
    if config.simulate is not None:
        sources += _walks(config.simulate, code)
    return sources, notes


def _files(
    recordings: cfg.Recordings, data: Path | Sequence[Path] | None
) -> tuple[list[tuple[str, Path]], list[str]]:
    if data is None:
        raise UsageError("the study reads recordings; say where they are with --data FOLDER")
    roots = [data] if isinstance(data, Path) else list(data)
    names: dict[str, Path] = {}
    notes: list[str] = []
    for root in roots:
        if not root.exists():
            raise UsageError(f"{root}: no such file or folder; give the folder of the recordings with --data")
        base = root if root.is_dir() else root.parent
        paths = sorted({p for g in recordings.files for p in root.glob(g)}) if root.is_dir() else [root]
        if root.is_dir() and (left := _left_out(root, paths)):
            some = ", ".join(str(p.relative_to(root)) for p in left[:3])
            notes.append(
                f"{len(left)} of {len(left) + len(paths)} files in {root} do not match `files` "
                f"({', '.join(recordings.files)}) and are left out: {some}{' …' if len(left) > 3 else ''}"
            )
        # The truth of a simulated walk stands beside its log and belongs to it.
        for path in (p for p in paths if p.is_file() and ".truth." not in p.name):
            name = str(path.relative_to(base).with_suffix("").as_posix())
            other = names.get(name)
            if other is None:
                names[name] = path
            elif ".mcap" in (path.suffix, other.suffix) and path.suffix != other.suffix:
                names[name] = path if path.suffix == ".mcap" else other
                raw = other if path.suffix == ".mcap" else path
                notes.append(
                    f"{raw.name} is left out: {names[name].name} beside it is taken for the same walk"
                )
            else:
                raise UsageError(
                    f"{path}: {other} has the same name {name!r}; narrow `files` in [recordings]"
                )
    if not names:
        where = ", ".join(str(r) for r in roots)
        raise UsageError(f"{where}: no file matches {', '.join(recordings.files)}; check --data and `files`")
    return sorted(names.items()), notes


def _left_out(root: Path, paths: Sequence[Path]) -> list[Path]:
    """Return the files of a folder, and of those in it, that no pattern takes: hidden ones and truth apart."""
    taken = set(paths)
    return [
        p
        for p in files_below(root)
        if p not in taken
        and ".truth." not in p.name
        and p.suffix != ".toml"
        and not any(part.startswith(".") for part in p.relative_to(root).parts)
    ]


def _source(recordings: cfg.Recordings, name: str, path: Path, code: str) -> StudyRecording:
    raw = path.suffix != ".mcap"
    beside = sorted(path.parent.glob(f"{glob.escape(path.stem)}.truth.*")) if raw else []
    rule = cfg.truth(recordings, path.name)
    facts = cfg.TruthRule() if beside else rule  # what a walk knows of itself counts
    truth = {k: v for k, v in (("closed", facts.closed), ("length_m", facts.length_m)) if v is not None}
    options = recordings.options if raw else {}
    survey = path.parent / rule.survey if rule.survey else None
    if survey is not None and not survey.is_file():
        raise UsageError(f"{survey}: no such file; it is the survey of {path.name} in [[recordings.truth]]")
    content = [file_digest(p) for p in (path, *beside, *([survey] if survey else []))]
    return StudyRecording(
        name=name,
        kind="raw" if raw else "mcap",
        digest=digest(content, path.name, recordings.format if raw else None, options, truth, code),
        path=str(path.resolve()),
        format=recordings.format if raw else None,
        options=options,
        truth=truth,
        size=path.stat().st_size,
        survey="" if survey is None else str(survey.resolve()),
    )


def _walks_of(label: str, count: Any) -> int:
    if not isinstance(count, int) or isinstance(count, bool) or count < 1:
        raise UsageError(f"simulate.configurations.{label}: walks = {count!r} is no whole number above 0")
    return count


def _walks(simulate: cfg.Simulate, code: str) -> list[StudyRecording]:
    walks: list[StudyRecording] = []
    several = len(simulate.scenarios) > 1
    for scenario in simulate.scenarios:
        for label, own in simulate.configurations.items():
            sensor = {k: v for k, v in own.items() if k != "walks"}
            for number in range(1, _walks_of(label, own.get("walks", simulate.walks)) + 1):
                seed = simulate.seed + len(walks)
                draw = random.Random(seed)
                varied = {k: draw.uniform(*simulate.vary[k]) for k in sorted(simulate.vary)}
                options = {**simulate.options, **varied, **sensor}
                walks.append(
                    StudyRecording(
                        name=f"{scenario}-{label}-{number:03d}",
                        kind="simulated",
                        digest=digest(scenario, seed, options, code),
                        options=options,
                        scenario=scenario,
                        seed=seed,
                        configuration=f"{scenario} {label}" if several else label,
                    )
                )
    return walks


def jobs(config: cfg.StudyConfig, source: StudyRecording) -> list[Job]:
    """Return every method on one recording with its key."""
    more = [config.withhold] if config.withhold else []  # else the keys of older studies stay
    return [
        Job(digest(source.digest, source.name, config.inputs, method, config.by, *more), method)
        for method in cfg.methods(config)
    ]


def check_methods(methods: Iterable[cfg.Method]) -> None:
    """Build every estimator once.

    Raises
    ------
    UsageError
        Where a name, preset or parameter is wrong: before anything runs.
    """
    for method in methods:
        try:
            make(method.estimator, preset=method.preset or None, **method.params)
        except AlgorithmError as error:
            raise UsageError(f"study: {error}") from None


def tasks(
    config: cfg.StudyConfig,
    sources: Sequence[StudyRecording],
    done: Iterable[str],
    folder: Path,
    processes: int,
) -> list[StudyTask]:
    """Return what is left to do: a task a recording, more where recordings are fewer than processes."""
    finished = set(done)
    left = [(s, [j for j in jobs(config, s) if j.key not in finished]) for s in sources]
    left = [(s, js) for s, js in left if js]
    pieces = max(1, -(-4 * processes // len(left))) if left and len(left) < 2 * processes else 1
    result: list[StudyTask] = []
    for source, todo in left:
        size = -(-len(todo) // pieces)
        for start in range(0, len(todo), size):
            part = todo[start : start + size]
            result.append(
                StudyTask(
                    name=digest([j.key for j in part]),
                    source=source,
                    jobs=part,
                    inputs=config.inputs,
                    folder=str(folder),
                    by=config.by,
                    withhold=config.withhold,
                )
            )
    # The largest first: no long task is left for the end.
    return sorted(result, key=lambda t: (-t.source.size, t.source.name))


def preparations(todo: Sequence[StudyTask]) -> list[StudyTask]:
    """Return a task without jobs for every recording that several tasks share: it is made once, first."""
    counts = Counter(task.source.name for task in todo)
    shared = {task.source.name: task for task in todo if counts[task.source.name] > 1}
    return [msgspec.structs.replace(task, jobs=[]) for task in shared.values()]
