"""Kill commands at random instants and look at what is left: ``python -m tests.kills 200``.

After each kill: no output that is not whole, no process of the command after 10 s. After the next run of the
same command: the output, and nothing else, here and in the place for temporary files.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import marcha.recording as mr
import numpy as np
from marcha.ingest.simulate import simulate

PATIENCE_S = 10.0
"""How long a process of a killed command may take to end."""
STUDY = """
[recordings]
files = ["*.csv"]
[[estimators]]
name = "foot.naive"
[[estimators]]
name = "foot.9iez"
"""


@dataclass(frozen=True)
class Command:
    """One command: its arguments, what it writes, and whether that is whole."""

    name: str
    arguments: tuple[str, ...]
    output: str = ""
    whole: Callable[[Path], bool] = lambda _: True


def sound(path: Path) -> bool:
    """Whether a recording can be read to its end."""
    with mr.open(path) as rec:
        return not rec.findings and all(
            rec.table(t).height == c.count for t, c in rec.channels.items() if c.columns
        )


def full(path: Path) -> bool:
    """Whether an export of tables has all its files."""
    return (path / "channels.json").is_file() and len(list(path.glob("*.csv"))) >= 2


def dataset(path: Path) -> bool:
    """Whether a dataset of BIDS has its description, its marks and a table."""
    return (path / "dataset_description.json").is_file() and any(path.rglob("*_motion.tsv"))


def any_file(path: Path) -> bool:
    """Whether a file has content."""
    return path.stat().st_size > 0


WALK = ("-e", "foot.9iez")
COMMANDS = (
    Command("convert", ("convert", "logs/conf-3333-walk.csv", "-o", "out.mcap"), "out.mcap", sound),
    Command("convert zip", ("convert", "logs/walk.zip", "-o", "out.mcap"), "out.mcap", sound),
    Command("replay", ("replay", "in.mcap", "-e", "foot.9iez", "-o", "out.mcap"), "out.mcap", sound),
    Command("export csv", ("export", "in.mcap", "--to", "csv", "-o", "out"), "out", full),
    Command("export matlab", ("export", "in.mcap", "--to", "matlab", "-o", "out.mat"), "out.mat", any_file),
    Command(
        "annotate",
        ("annotate", "add", "in.mcap", "--label", "x", "--from", "1", "-o", "out.mcap"),
        "out.mcap",
        sound,
    ),
    Command(
        "study",
        ("study", "study.toml", "-o", "out", "--workers", "2", "--data", "logs"),
        "out",
    ),
    Command("cut", ("cut", "in.mcap", "--start", "1", "--end", "20", "-o", "out.mcap"), "out.mcap", sound),
    Command(
        "merge",
        ("merge", "in.mcap", "in.mcap", "--prefix", "/a", "--prefix", "/b", "-o", "out.mcap"),
        "out.mcap",
        sound,
    ),
    Command("anonymize", ("anonymize", "in.mcap", "-o", "out.mcap"), "out.mcap", sound),
    Command("report", ("report", "done.mcap", "--no-picture", "-o", "out.html"), "out.html", any_file),
    Command("view", ("view", "done.mcap", "--rrd", "out.rrd"), "out.rrd", any_file),
    Command("export bids", ("export", "in.mcap", "--to", "bids", "-o", "out"), "out", dataset),
    Command("simulate", ("simulate", "rectangle", "-o", "out"), "out"),
    Command("demo", ("demo", "-o", "out"), "out"),
    Command("align", ("align", "leg.mcap", "-o", "out.mcap"), "out.mcap", sound),
    Command(
        "calibrate",
        ("calibrate", "imu", "in.mcap", "--input", "/foot/imu1", "-o", "out.json"),
        "out.json",
        any_file,
    ),
    Command("evaluate", ("evaluate", "done.mcap")),
    Command("check", ("check", "in.mcap")),
    Command("info", ("info", "in.mcap")),
    Command("tune", ("tune", "in.mcap", *WALK, "-p", "window_s=0.05:0.1:3", "--length-m", "22")),
)
PRINTING = {"formats", "estimators", "completion"}
"""Commands that print what is installed: they read no file of the user, and write none."""


@contextmanager
def prepared() -> Iterator[Path]:
    """Give a folder with a log, a recording and a study."""
    folder = Path(tempfile.mkdtemp(prefix="kills-"))
    try:
        (folder / "logs").mkdir()
        (folder / "tmp").mkdir()
        made = simulate("rectangle", folder / "raw", seed=1).paths[0]
        shutil.copy(made, folder / "logs" / "conf-3333-walk.csv")
        (folder / "study.toml").write_text(STUDY)
        run(folder, ("convert", "logs/conf-3333-walk.csv", "-o", "in.mcap")).communicate()
        run(folder, ("replay", "in.mcap", *WALK, "-o", "done.mcap")).communicate()
        squats = simulate("squats", folder / "raw", seed=1).paths
        run(folder, ("convert", *map(str, squats), "-o", "leg.mcap")).communicate()
        shutil.make_archive(str(folder / "packed"), "zip", folder / "logs")
        shutil.rmtree(folder / "raw")
        (folder / "packed.zip").rename(folder / "logs" / "walk.zip")
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def run(folder: Path, arguments: tuple[str, ...]) -> subprocess.Popen[bytes]:
    """Start a command in a session of its own, its temporary files in ``tmp``."""
    return subprocess.Popen(
        [sys.executable, "-m", "marcha.cli", *arguments],
        cwd=folder,
        env={**os.environ, "TMPDIR": str(folder / "tmp")},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def living(session: int) -> list[int]:
    """Return the processes of a session that still live."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[3]) == session and fields[0] != "Z":
                found.append(int(entry.name))
    return found


def gone(session: int, patience_s: float) -> bool:
    """Whether all processes of a session end within a time."""
    until = time.monotonic() + patience_s
    while living(session):
        if time.monotonic() > until:
            return False
        time.sleep(0.02)
    return True


def names(folder: Path) -> set[str]:
    """Return what lies in the folder, and in its place for temporary files."""
    return {p.name for p in folder.iterdir()} | {f"tmp/{p.name}" for p in (folder / "tmp").iterdir()}


def clear(folder: Path, keep: set[str]) -> None:
    """Remove what a command wrote."""
    for name in names(folder) - keep:
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def once(folder: Path, command: Command, after_s: float, number: int = signal.SIGKILL) -> list[str]:
    """End a command after a time and return what is wrong then, and after its next run."""
    before = names(folder)
    process = run(folder, command.arguments)
    try:
        process.wait(after_s)
    except subprocess.TimeoutExpired:
        os.kill(process.pid, number)  # the command itself, not what it started
    sent = time.monotonic()
    process.communicate()
    took = time.monotonic() - sent
    wrong = []
    output = folder / command.output
    if number == signal.SIGKILL:
        if not gone(process.pid, PATIENCE_S):
            wrong.append(f"processes live on: {living(process.pid)}")
    else:
        if process.returncode not in (0, 3, 128 + number, -number):
            wrong.append(f"exit code {process.returncode}")
        if took > 2.0:
            wrong.append(f"took {took:.1f} s to end")
        if not gone(process.pid, 1.0):
            wrong.append(f"processes live on: {living(process.pid)}")
        left = names(folder) - before - {command.output}
        if left:
            wrong.append(f"left behind at once: {sorted(left)}")
    for pid in living(process.pid):
        os.kill(pid, signal.SIGKILL)
    if command.output and output.exists() and not command.whole(output):
        wrong.append("the output is not whole")
    again = run(folder, (*command.arguments, *(["--force"] if command.output else [])))
    _, said = again.communicate()
    if again.returncode not in (0, 3):
        wrong.append(f"the next run fails: {again.returncode} {said.decode()[-200:]}")
    elif command.output and not (output.exists() and command.whole(output)):
        wrong.append("the next run's output is not whole")
    gone(again.pid, PATIENCE_S)
    left = names(folder) - before - {command.output}
    if command.output and output.is_dir():
        left |= {str(p.relative_to(folder)) for p in output.rglob(".*")}
    if left:
        wrong.append(f"left behind: {sorted(left)}")
    clear(folder, before)
    return wrong


def main() -> int:
    """Kill as often as asked; exit code 1 where anything was wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.kills", description=__doc__)
    parser.add_argument("kills", type=int, nargs="?", default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--signal", default="SIGKILL", help="SIGKILL, SIGTERM or SIGINT")
    parser.add_argument("--only", default="", help="commands whose name has this")
    given = parser.parse_args()
    rng, failures = np.random.default_rng(given.seed), 0
    number = getattr(signal, given.signal)
    chosen = [c for c in COMMANDS if given.only in c.name]
    with prepared() as folder:
        lasts = {}
        for command in chosen:
            before, begun = names(folder), time.monotonic()
            run(folder, command.arguments).communicate()
            lasts[command.name] = time.monotonic() - begun
            clear(folder, before)
        for k in range(given.kills):
            command = chosen[k % len(chosen)]
            after_s = float(rng.uniform(0.02, 1.0)) * lasts[command.name]
            for wrong in once(folder, command, after_s, number):
                failures += 1
                print(
                    f"{command.name} after {after_s:.2f} of {lasts[command.name]:.2f} s: {wrong}", flush=True
                )
            if (k + 1) % 10 == 0:
                print(f"{k + 1} × {given.signal}: {failures} failures", flush=True)
    print(f"{given.kills} × {given.signal}: {failures} failures")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
