"""What is fuzzed, and what no input may make it do."""

from __future__ import annotations

import contextlib
import io
import json
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import marcha.recording as mr
import msgspec
import numpy as np
from marcha import ingest
from marcha.cli import main
from marcha.recording import Finding, MarchaError
from marcha.recording.check import check

from . import mcap, mutators, seeds, structures
from .mutators import Mutated, Rng, pick
from .seeds import Rows, Sample, Seeds
from .server import CPU_S, Failure, restart_clock

MOST_CHARACTERS = 1200
"""Of a message."""
WHOLE = "/reference/optical/"
"""Channels whose every row depends on all frames of a capture (clusters of markers)."""
ZIPPED = 0.05
"""Share of logs that come in an archive."""
BY_COMMAND = 0.04
"""Share of inputs that go through a whole command, which takes longer to read its line than a small file."""
DRAWING = ("view", "report")
"""Commands that load what draws, which no process that forks may have loaded: it starts threads."""
_CODES = (0, 1, 2, 3, 4)
_WROTE = (0, 3, 4)


@dataclass(frozen=True)
class Target:
    """A kind of input: ``run`` makes the input of a random generator in a folder, and judges what came of it.

    A cheap one has several ``turns`` while a costly one has one.
    """

    name: str
    run: Callable[[Rng, Path], None]
    turns: int = 1


def call(folder: Path, action: Callable[[], Any], output: Path | None = None) -> Any:
    """Call the library, judge what it says and leaves, and return what it returns; None where it refuses."""
    before = _files(folder)
    try:
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            found = action()
    except MarchaError as error:
        _judge_line(str(error))
        if left := _files(folder) - before:
            raise Failure("left behind", f"{sorted(map(str, left))[:3]} after {error}"[:300]) from None
        return None
    for said in warned:
        if not issubclass(said.category, UserWarning):  # which marcha's own are
            raise Failure("message", f"{said.filename}:{said.lineno}: {said.message}")
    left = {p for p in _files(folder) - before if p.name.startswith(".")}
    if left or (output is not None and not output.exists()):
        raise Failure("left behind", f"{sorted(map(str, left))[:3]}, or no output")
    return found


def _judge_line(line: str) -> None:
    if len(line) > MOST_CHARACTERS:
        raise Failure("message", f"{len(line)} characters: {line[:100]!r}")
    if not line.isprintable():
        raise Failure("control character", repr(line)[:200])


def command(folder: Path, arguments: Sequence[object], output: Path | None = None) -> tuple[int, str]:
    """Run a command, judge its words and outputs, and return its exit code and what it printed."""
    before = _files(folder)
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(a) for a in arguments])
    if code not in _CODES:
        raise Failure("exit code", f"{code} of {arguments}")
    lines = err.getvalue().splitlines()
    for line in lines:
        if not line.startswith("marcha: "):
            raise Failure("message", f"not one of marcha's: {line[:300]!r}")
        _judge_line(line)
        if "out of memory" in line:
            raise Failure("memory", line[:300])
    if code in (1, 2) and not [x for x in lines if not x.startswith("marcha: warning: ")]:
        raise Failure("message", f"none with exit code {code}")
    for text in (out.getvalue(),):
        odd = next((c for c in text if not c.isprintable() and c != "\n"), None)
        if odd is not None:
            at = text.index(odd)
            raise Failure("control character", repr(text[max(0, at - 100) : at + 50]))
    made = _files(folder) - before
    allowed = {output} if output is not None and code in _WROTE else set()
    left = {
        p
        for p in made
        if not any(p == a or a in p.parents or _beside(p, a) for a in allowed if a is not None)
    }
    if left:
        raise Failure("left behind", f"code {code}: {sorted(map(str, left))[:3]}")
    if output is not None and code in (0, 3) and not output.exists():
        raise Failure("no output", f"code {code}: {output.name}")
    return code, out.getvalue()


def _beside(path: Path, output: Path) -> bool:
    """Whether a file is one that belongs to an output: side files are named like it."""
    return (
        path.parent == output.parent
        and path.name.startswith(output.stem.split(".")[0])
        and not path.name.startswith(".")
    )


def _files(folder: Path) -> set[Path]:
    return {Path(base) / name for base, folders, names in os.walk(folder) for name in (*folders, *names)}


def compare(found: Rows, sound: Rows, most: int) -> None:
    """Refuse more than ``most`` rows of a channel that the sound input does not have."""
    every = np.concatenate([*sound.values(), np.empty(0, np.uint64)])
    for topic, rows in found.items():
        # A number in a topic's name may change with the sources that a log tells of.
        foreign = int(np.count_nonzero(~np.isin(rows, sound.get(topic, every))))
        if foreign > most:
            raise Failure(
                "value",
                f"{topic}: {foreign} of {len(rows)} rows are none of the sound input's, {most} touched",
            )


# -- raw logs ----------------------------------------------------------------------------------------------


def importing(sample: Sample) -> Target:
    """Convert damaged logs of one format."""

    def run(rng: Rng, folder: Path) -> None:
        files = dict(sample.files)
        name = _chosen(rng, sample)
        done = _damage(rng, name, files[name])
        files[name] = done.data
        if len(files) > 1 and rng.random() < 0.02:
            files.pop(name)
        seeds.put(files, folder)
        path, out = folder / sample.main, folder / "out.mcap"
        if rng.random() < ZIPPED:
            path, done = _archive(rng, files, folder), Mutated(b"", None)
        options = {k: v.replace("{folder}", str(folder)) for k, v in sample.options.items()}
        named = sample.format if options or rng.random() < 0.8 else None
        if rng.random() < BY_COMMAND:
            given: list[object] = [x for k, v in options.items() for x in ("--set", f"{k}={v}")]
            given += ["--format", named] if named else []
            code, text = command(folder, ["convert", path, "-o", out, "--json", *given], out)
            if code not in (0, 3):
                return
            made = json.loads(text)
            report, format = made["report"], made["format"]
        else:
            made = call(folder, lambda: ingest.convert(path, out, format=named, options=options), out)
            if made is None:
                return
            report, format = msgspec.to_builtins(made.report), made.format
        if report["rows_read"] != report["rows_kept"] + report["rows_dropped"]:
            raise Failure("report", f"rows do not add up: {report}"[:300])
        with mr.open(out) as rec:
            found = seeds.rows_of(rec, times=False)
            if rec.findings:
                raise Failure("output", f"is not sound: {rec.findings[0].detail}")
        if done.rows is not None and name == sample.main and format == sample.format:
            compare(
                {t: r for t, r in found.items() if not t.startswith(WHOLE)}, sample.rows, 2 + 3 * done.rows
            )

    return Target(f"import {sample.format} {sample.name}", run, turns=4)


def _chosen(rng: Rng, sample: Sample) -> str:
    if sample.main in sample.files and rng.random() < 0.8:
        return sample.main
    return str(pick(rng, sorted(sample.files)))


def _damage(rng: Rng, name: str, data: bytes) -> Mutated:
    if Path(name).suffix.lower() == ".toml":
        return mutators.toml(rng, data)
    return structures.inside(rng, name, data)


def _archive(rng: Rng, files: dict[str, bytes], folder: Path) -> Path:
    """Pack the files as a stranger would, and damage the archive."""
    path = folder / "in.zip"
    members = list(files.items())
    if rng.random() < 0.3:
        members.append((str(pick(rng, structures.NAMES)), b"1,2\n"))
    whole = structures.archived(members, int(pick(rng, structures.PACKINGS)))
    path.write_bytes(structures.zipped(rng, whole).data if rng.random() < 0.7 else whole)
    return path


# -- recordings --------------------------------------------------------------------------------------------


def reading(data: dict[str, bytes], sound: dict[str, Rows]) -> Target:
    """Read damaged recordings, and do with them what users do."""

    def run(rng: Rng, folder: Path) -> None:
        name = str(pick(rng, sorted(data)))
        done = mcap.mutate(rng, data[name])
        path = folder / "in.mcap"
        path.write_bytes(done.data)
        opened = call(folder, lambda: _examined(path))
        if opened is None:
            return
        said, found = opened
        if done.rows is not None:
            compare(found, sound[name], 0)
            lost = sum(map(len, sound[name].values())) - sum(map(len, found.values()))
            if lost and not said:
                raise Failure("silent loss", f"{lost} rows are lost ({done.what}), and check finds nothing")
        if rng.random() < BY_COMMAND:
            _use(rng, folder, path)

    return Target("read mcap", run)


def _examined(path: Path) -> tuple[list[Finding], Rows]:
    with mr.open(path) as rec:
        return check(rec), seeds.rows_of(rec, times=True)


def using(data: dict[str, bytes], to: str) -> Target:
    """Export recordings with odd contents that are sound by the format's rules."""

    def run(rng: Rng, folder: Path) -> None:
        path = folder / "in.mcap"
        path.write_bytes(mcap.odd(rng, data[str(pick(rng, sorted(data)))]))
        if to:
            _export(rng, folder, path, to)
        else:
            code, _ = command(folder, ["check", path, "--json"])
            if code in (0, 3):
                _use(rng, folder, path)

    return Target(f"export {to}" if to else "use recordings", run)


def _use(rng: Rng, folder: Path, path: Path) -> None:
    from marcha.export import available

    ways = _ways(folder, path)
    at = int(rng.integers(len(ways) + 4))
    if at < len(ways):
        arguments, output = ways[at]
        if arguments[0] in DRAWING:
            for module in ("marcha.viz.joint_figures", "matplotlib.backends.backend_agg", "scipy.signal"):
                import_module(module)
            restart_clock(2 * CPU_S)  # a page of five figures takes 3 s of whatever recording
        command(folder, arguments, output)
    else:
        _export(rng, folder, path, str(pick(rng, sorted(available()))))


def _ways(folder: Path, path: Path) -> list[tuple[list[object], Path | None]]:
    """Return commands that users give a recording, and what each writes."""
    out = folder / "used.mcap"
    return [
        (["info", path], None),
        (["check", path], None),
        (["evaluate", path], None),
        (["evaluate", path, "--json"], None),
        (["annotate", "list", path], None),
        (["annotate", "add", path, "--label", "x", "--from", "0.1", "-o", out], out),
        (["replay", path, "-e", "foot.naive", "-o", out], out),
        (["replay", path, "-e", "phone.steps", "-o", out, "--json"], out),
        (["cut", path, "--start", "0.1", "--end", "0.5", "-o", out], out),
        (["anonymize", path, "-o", out], out),
        (["merge", path, path, "--prefix", "/a", "--prefix", "/b", "-o", out], out),
        (["calibrate", "imu", path], None),
        (["view", path, "--rrd", folder / "used.rrd"], folder / "used.rrd"),
        (["report", path, "--no-picture", "-o", folder / "used.html"], folder / "used.html"),
    ]


def warm(sound: Seeds, folder: Path) -> None:
    """Do all that users do with a recording once: what is compiled at first use is no hang of an input."""
    path = folder / "in.mcap"
    path.write_bytes(sound.recordings["walk"])
    for arguments, output in _ways(folder, path):
        command(folder, [*arguments, "--force"] if output else arguments, output)


def _export(rng: Rng, folder: Path, path: Path, to: str) -> None:
    from marcha.export import available

    out = folder / f"made{available()[to].suffix}"
    if rng.random() >= 5 * BY_COMMAND:
        call(folder, lambda: _exported(path, to, out), out)
        return
    command(folder, ["export", path, "--to", to, "-o", out], out)


def _exported(path: Path, to: str, out: Path) -> list[Path]:
    from marcha.export import export

    with mr.open(path) as rec:
        return export(rec, to, out)


# -- other files ----------------------------------------------------------------------------------------------


def importing_labels(files: dict[str, bytes], rec: bytes) -> Target:
    """Read damaged labels of every format."""

    def run(rng: Rng, folder: Path) -> None:
        name = str(pick(rng, sorted(files)))
        given = dict(files) if rng.random() < 0.5 else {name: files[name]}
        given[name] = structures.inside(rng, name, files[name]).data
        seeds.put(given | {"in.mcap": rec}, folder)
        out = folder / "out.mcap"
        command(folder, ["annotate", "import", folder / "in.mcap", folder / name, "-o", out], out)

    return Target("labels", run)


def configuring(files: dict[str, bytes]) -> Target:
    """Read damaged configurations of studies."""

    def run(rng: Rng, folder: Path) -> None:
        from marcha.study import config

        path = folder / "study.toml"
        path.write_bytes(mutators.toml(rng, files[str(pick(rng, sorted(files)))]).data)
        call(folder, lambda: config.load(path))

    return Target("study toml", run, turns=4)


def calibrating(rec: bytes) -> Target:
    """Replay with damaged calibrations."""
    sound = json.dumps(
        {
            "kind": "imu",
            "subject": "/foot/imu1",
            "values": {f"gyr_bias_{a}_rad_s": 0.01 for a in "xyz"},
            "covariance": {"gyr_bias": [[1e-6, 0, 0], [0, 1e-6, 0], [0, 0, 1e-6]]},
            "computed_from": [{"recording": "a", "blake2b": "b", "start_ns": "0", "end_ns": "1"}],
        },
        indent=1,
    ).encode()

    def run(rng: Rng, folder: Path) -> None:
        path, out = folder / "in.mcap", folder / "out.mcap"
        path.write_bytes(rec)
        (folder / "c.json").write_bytes(structures.inside(rng, "c.json", sound).data)
        command(
            folder, ["replay", path, "-e", "foot.naive", "--calibration", folder / "c.json", "-o", out], out
        )

    return Target("calibration", run)


def targets(sound: Seeds) -> list[Target]:
    """Return a target for every importer, exporter and reader that is registered."""
    from marcha.export import available

    return [
        *map(importing, sound.samples),
        *[reading(sound.recordings, sound.rows)] * 8,  # where most structure can be damaged
        importing_labels(sound.labels, sound.recordings["example"]),
        configuring(sound.studies),
        calibrating(sound.recordings["walk"]),
        *(using(sound.recordings, name) for name in ("", *sorted(available()))),
    ]
