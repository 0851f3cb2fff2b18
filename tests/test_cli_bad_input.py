"""Bad input: one clear line or a finding, the agreed exit code, and never a partial or overwritten output."""

from __future__ import annotations

import gzip
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from .cli_helpers import Ran, marcha, marcha_process

ROWS = 400


def rows(count: int = ROWS) -> list[str]:
    """Return serial text of a foot that rests and shakes, one row an element."""
    rng = np.random.default_rng(0)
    counts = rng.integers(-300, 300, (count, 12))
    counts[:, [2, 8]] += 2048
    return [f"{1000 + 10 * i},{','.join(map(str, row))}" for i, row in enumerate(counts)]


def text(lines: list[str], end: str = "\r\n\r\n") -> bytes:
    return "".join(line + end for line in lines).encode()


def convert(folder: Path, data: bytes, *options: object, name: str = "conf-3333-x.csv") -> Ran:
    (folder / name).write_bytes(data)
    return marcha("convert", folder / name, "-o", folder / "out.mcap", "--json", *options)


def kinds(done: Ran) -> set[str]:
    return {f["kind"] for f in done.document["report"]["findings"]}


def test_a_good_log_is_good(tmp_path: Path) -> None:
    done = convert(tmp_path, text(rows()))
    assert done.code == 0
    assert [c["count"] for c in done.document["channels"]] == [ROWS, ROWS]


# -- what cannot be read ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "empty"),
        (bytes(range(256)) * 40, "unknown content"),
        (b"\x00" * 5000, "unknown content"),
        (b"a page of notes\nnothing else\n", "unknown content"),
        (text([r.rsplit(",", 4)[0] for r in rows()]), ""),
    ],
    ids=["empty", "binary", "zeros", "notes", "nine columns"],
)
def test_unreadable_content_is_one_line_and_no_output(tmp_path: Path, data: bytes, said: str) -> None:
    done = convert(tmp_path, data)
    assert done.code == 1
    assert "conf-3333-x.csv" in done.complaint
    assert said in done.complaint
    assert {p.name for p in tmp_path.iterdir()} == {"conf-3333-x.csv"}


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (gzip.compress(text(rows())), "gunzip"),
        (text(rows()).decode().encode("utf-16"), "save it as UTF-8"),
        (b"\x89MCAP0\r\n" + bytes(50), "a recording already"),
        (b"PK\x03\x04 and no more", "damaged zip"),
    ],
    ids=["gzip", "utf-16", "recording", "damaged zip"],
)
def test_what_a_user_may_take_for_a_log_is_named_with_its_remedy(
    tmp_path: Path, data: bytes, said: str
) -> None:
    done = convert(tmp_path, data)
    assert done.code == 1
    assert said in done.complaint
    assert not (tmp_path / "out.mcap").exists()


def test_a_byte_order_mark_costs_no_row(tmp_path: Path) -> None:
    done = convert(tmp_path, b"\xef\xbb\xbf" + text(rows()))
    assert done.code == 0
    assert done.document["report"]["rows_kept"] == ROWS


def test_an_input_given_twice_is_wrong_usage(tmp_path: Path) -> None:
    log = tmp_path / "conf-3333-x.csv"
    log.write_bytes(text(rows()))
    done = marcha("convert", log, tmp_path / "." / log.name, "-o", tmp_path / "out.mcap", "--json")
    assert done.code == 2
    assert "given twice" in done.complaint


def test_failure_is_json_too(tmp_path: Path) -> None:
    done = convert(tmp_path, b"")
    assert done.document == {"error": done.complaint, "exit_code": 1}


@pytest.mark.parametrize("command", [("info",), ("check",), ("replay", "-e", "foot.9iez"), ("evaluate",)])
@pytest.mark.parametrize(
    "data", [b"", b"\x89MCAP", b"not a recording at all" * 99], ids=["empty", "head", "text"]
)
def test_a_recording_that_is_none(tmp_path: Path, command: tuple[str, ...], data: bytes) -> None:
    (tmp_path / "x.mcap").write_bytes(data)
    done = marcha(command[0], tmp_path / "x.mcap", *command[1:])
    assert done.code == 1
    assert "x.mcap" in done.complaint


@pytest.mark.parametrize(
    "arguments",
    [
        ("convert", "missing.csv", "-o", "out.mcap"),
        ("info", "missing.mcap"),
        ("check", "missing.mcap"),
        ("replay", "missing.mcap", "-e", "foot.9iez"),
        ("evaluate", "missing.mcap"),
        ("view", "missing.mcap", "--rrd", "a.rrd"),
        ("export", "missing.mcap", "--to", "csv", "-o", "out"),
        ("annotate", "list", "missing.mcap"),
        ("annotate", "add", "missing.mcap", "--label", "x", "--from", "1", "--in-place"),
    ],
    ids=lambda a: " ".join(a[:2]),
)
def test_a_missing_file_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    done = marcha(*arguments)
    assert done.code == 1
    assert "missing" in done.complaint
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", [("info",), ("check",), ("replay", "-e", "foot.9iez"), ("evaluate",)])
def test_a_folder_is_no_recording(tmp_path: Path, command: tuple[str, ...]) -> None:
    done = marcha(command[0], tmp_path, *command[1:])
    assert done.code in (1, 2)
    assert str(tmp_path) in done.complaint


def test_a_missing_folder_for_the_output(tmp_path: Path) -> None:
    (tmp_path / "conf-3333-x.csv").write_bytes(text(rows()))
    done = marcha("convert", tmp_path / "conf-3333-x.csv", "-o", tmp_path / "no" / "where" / "a.mcap")
    assert done.code == 1
    assert "there is no folder" in done.complaint
    assert "no/where" in done.complaint.replace(os.sep, "/")
    assert not (tmp_path / "no").exists()


# -- what is read, and said ---------------------------------------------------------------------------


def broken(change: Callable[[list[str]], list[str]]) -> bytes:
    return text(change(rows()))


def replaced(at: int, new: str) -> bytes:
    lines = rows()
    lines[at] = new
    return text(lines)


def restamped(stamp: Callable[[int, int], int]) -> bytes:
    lines = [line.split(",", 1) for line in rows()]
    return text([f"{stamp(i, int(t))},{rest}" for i, (t, rest) in enumerate(lines)])


def dead_sensor() -> bytes:
    return text([",".join(line.split(",")[:7] + ["0"] * 6) for line in rows()])


DEFECTS = [
    ("wrong column count", replaced(200, "3000,1,2,3"), "bad_row"),
    ("non-numeric cell", replaced(200, rows()[200].replace(",", ",x", 1)), "bad_row"),
    ("cut in the middle of the last row", text(rows())[:-30], "bad_row"),
    ("boot chatter", b"Configuring MPU-01...\r\n" + text(rows()), "chatter"),
    ("duplicate time", restamped(lambda i, t: t - 10 * (i == 200)), "duplicate_time"),
    ("backwards time", restamped(lambda i, t: t - 500 * (i == 200)), "backwards_time"),
    ("roll-over", restamped(lambda i, t: (2**32 - 2000 + t) % 2**32), "counter_rollover"),
    ("dead sensor", dead_sensor(), "all_zero"),
    ("gap", text(rows()[:200] + rows()[250:]), "gap"),
]


@pytest.mark.parametrize(("data", "kind"), [d[1:] for d in DEFECTS], ids=[d[0] for d in DEFECTS])
def test_a_defect_is_a_finding(tmp_path: Path, data: bytes, kind: str) -> None:
    done = convert(tmp_path, data)
    assert done.code in (0, 3)
    assert kind in kinds(done)


@pytest.mark.parametrize("name", ["wrong column count", "non-numeric cell", "dead sensor"])
def test_loss_and_repair_exit_with_3(tmp_path: Path, name: str) -> None:
    assert convert(tmp_path, next(data for n, data, _ in DEFECTS if n == name)).code == 3


def test_a_defect_is_also_said_by_check(tmp_path: Path) -> None:
    convert(tmp_path, dead_sensor())
    done = marcha("check", tmp_path / "out.mcap", "--json")
    assert done.code == 3
    assert "all_zero" in {f["kind"] for f in done.document["import_findings"]}


def test_the_first_line_of_a_defect_is_named(tmp_path: Path) -> None:
    done = convert(tmp_path, replaced(200, "3000,1,2,3"))
    (finding,) = (f for f in done.document["report"]["findings"] if f["kind"] == "bad_row")
    assert finding["first_line"] == 401  # every row is followed by a blank line


def test_mixed_line_ends_change_nothing(tmp_path: Path) -> None:
    ends = ["\r\n", "\n", "\r\n\r\n", "\n\n"]
    done = convert(tmp_path, "".join(r + ends[i % 4] for i, r in enumerate(rows())).encode())
    assert [c["count"] for c in done.document["channels"]] == [ROWS, ROWS]


@given(at=st.integers(0, 8000), cut=st.integers(0, 60), junk=st.binary(max_size=40), tail=st.integers(0, 400))
def test_any_damage_gives_a_report_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, at: int, cut: int, junk: bytes, tail: int
) -> None:
    """Bytes cut out, thrown in, lost at the end: every row is kept or dropped, and counted."""
    folder = tmp_path_factory.mktemp("damaged")
    data = text(rows(150))
    damaged = data[:at] + junk + data[at + cut :]
    done = convert(folder, damaged[: len(damaged) - tail])
    assert done.code in (0, 1, 3)
    if done.code == 1:
        assert "conf-3333-x.csv" in done.complaint
        assert not (folder / "out.mcap").exists()
    else:
        report = done.document["report"]
        assert report["rows_read"] == report["rows_kept"] + report["rows_dropped"]
        assert done.document["channels"][0]["count"] == report["rows_kept"]


# -- outputs that are there, disks that are full, processes that are killed ---------------------------


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    done = convert(folder, text(rows(3000)))
    assert done.code == 0, done.err
    return folder / "out.mcap"


WRITERS: list[tuple[str, tuple[object, ...], str]] = [
    ("replay", ("replay", "IN", "-e", "foot.naive", "-o", "OUT"), "out.mcap"),
    ("replay --rrd", ("replay", "IN", "-e", "foot.naive", "--rrd", "OUT"), "out.rrd"),
    ("view --rrd", ("view", "IN", "--rrd", "OUT"), "out.rrd"),
    ("annotate", ("annotate", "add", "IN", "--label", "x", "--from", "1", "-o", "OUT"), "out.mcap"),
    ("export mcap", ("export", "IN", "--to", "mcap", "-o", "OUT"), "out.mcap"),
    ("export rrd", ("export", "IN", "--to", "rrd", "-o", "OUT"), "out.rrd"),
]


@pytest.mark.parametrize(("arguments", "name"), [w[1:] for w in WRITERS], ids=[w[0] for w in WRITERS])
def test_an_existing_output_is_left_alone(
    recording: Path, tmp_path: Path, arguments: tuple[object, ...], name: str
) -> None:
    out = tmp_path / name
    out.write_bytes(b"precious")
    done = marcha(*({"IN": recording, "OUT": out}.get(str(a), a) for a in arguments))
    assert done.code == 1
    assert "--force" in done.complaint
    assert out.read_bytes() == b"precious"
    assert list(tmp_path.iterdir()) == [out]


def test_an_existing_recording_is_not_converted_over(tmp_path: Path) -> None:
    (tmp_path / "out.mcap").write_bytes(b"precious")
    done = convert(tmp_path, text(rows()))
    assert done.code == 1
    assert (tmp_path / "out.mcap").read_bytes() == b"precious"


def test_force_replaces(tmp_path: Path) -> None:
    (tmp_path / "out.mcap").write_bytes(b"worthless")
    assert convert(tmp_path, text(rows()), "--force").code == 0
    assert marcha("info", tmp_path / "out.mcap").code == 0


def test_a_failure_with_force_keeps_the_old_file(tmp_path: Path) -> None:
    (tmp_path / "out.mcap").write_bytes(b"precious")
    assert convert(tmp_path, b"", "--force").code == 1
    assert (tmp_path / "out.mcap").read_bytes() == b"precious"


FULL = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))"
FULL_CASES = [*WRITERS] + [
    (f"export {to}", ("export", "IN", "--to", to, "-o", "OUT"), "out") for to in ("csv", "parquet")
]
FULL_CASES.append(("simulate", ("simulate", "straight", "-o", "OUT"), "new"))


@pytest.mark.skipif(os.name != "posix", reason="needs a limit of file sizes")
@pytest.mark.parametrize(("arguments", "name"), [w[1:] for w in FULL_CASES], ids=[w[0] for w in FULL_CASES])
def test_a_full_disk_is_one_line_and_leaves_nothing(
    recording: Path, tmp_path: Path, arguments: tuple[object, ...], name: str
) -> None:
    given_ = [{"IN": recording, "OUT": tmp_path / name}.get(str(a), a) for a in arguments]
    done = marcha_process(*given_, code=FULL)
    assert done.code == 1, done.err
    assert re.search("File too large|is the disk full", done.complaint)
    assert done.complaint.startswith(f"{tmp_path / name}: ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(os.name != "posix", reason="needs a limit of file sizes")
def test_a_full_disk_on_convert(tmp_path: Path) -> None:
    (tmp_path / "conf-3333-x.csv").write_bytes(text(rows(3000)))
    done = marcha_process("convert", tmp_path / "conf-3333-x.csv", "-o", tmp_path / "a.mcap", code=FULL)
    assert done.code == 1
    assert "File too large" in done.complaint
    assert [p.name for p in tmp_path.iterdir()] == ["conf-3333-x.csv"]


STOP = """
from marcha.recording.mcapfile import McapFile
real = McapFile.finish
def finish(self):
    print("writing", flush=True)
    sys.stdin.read()
    real(self)
McapFile.finish = finish
"""


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGINT])
def test_a_process_that_is_ended_in_mid_write_leaves_no_output(
    tmp_path: Path, ending: signal.Signals
) -> None:
    """SIGKILL leaves one hidden .part at most, which the next run removes; an interrupt leaves nothing."""
    log = tmp_path / "conf-3333-x.csv"
    log.write_bytes(text(rows(3000)))
    program = f"import sys\n{STOP}\nfrom marcha.cli import main; sys.exit(main(sys.argv[1:]))"
    arguments = ["convert", str(log), "-o", str(tmp_path / "a.mcap")]
    process = subprocess.Popen(
        [sys.executable, "-c", program, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"writing\n"
    process.send_signal(ending)
    _, err = process.communicate(timeout=60)
    left = {p.name for p in tmp_path.iterdir()} - {log.name}
    if ending == signal.SIGKILL:
        assert process.returncode == -signal.SIGKILL
        assert all(name.startswith(".a.mcap.") and name.endswith(".part") for name in left)
    else:
        assert process.returncode == 130
        assert err.decode().startswith("marcha: interrupted")
        assert left == set()
    assert marcha(*arguments).code == 0
    assert {p.name for p in tmp_path.iterdir()} == {log.name, "a.mcap"}


def test_evaluate_of_a_run_that_failed_says_so_and_gives_no_metrics(tmp_path: Path) -> None:
    """A foot that shakes from the first sample to the last gives an estimator nothing to begin with."""
    assert convert(tmp_path, text(rows())).code in (0, 3)
    done = tmp_path / "done.mcap"
    replayed = marcha("replay", tmp_path / "out.mcap", "-e", "foot.9iez", "-o", done, "--json")
    assert all(run["fatal"] for run in replayed.document["runs"])
    runs = marcha("evaluate", done, "--json").document["runs"]
    assert runs
    shown = " ".join(marcha("evaluate", done).out.split())
    for run in runs:
        assert run["metrics"] == {}
        assert run["note"].startswith("results must not be used: ")
        assert " ".join(run["note"].split()) in shown
