"""The application itself: help, lazy imports, usage errors, bugs, pipes, shared options."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import warnings
from importlib import import_module
from pathlib import Path

import marcha.recording as mr
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.cli import contents
from marcha.cli.app import COMMANDS
from marcha.cli.console import TextTable, folded, number, progress
from marcha.cli.options import DEFAULT, instant, limits, settings
from marcha.cli.reference import page
from marcha.recording import UsageError

from .cli_helpers import marcha, marcha_process
from .conftest import ROOT

NAMES = [name for _, name, _, _ in COMMANDS]
LEAVES = [("annotate", "add"), ("annotate", "import"), ("annotate", "list")]
LEAVES += [(name,) for name in NAMES if name != "annotate"]
HEAVY = (
    "numpy",
    "polars",
    "numba",
    "scipy",
    "matplotlib",
    "rerun",
    "mcap",
    "msgspec",
    "ezc3d",
    "pyproj",
    "pyarrow",
)


def test_help_names_every_command() -> None:
    out = marcha("--help").out
    assert all(re.search(rf"^  {name}: ", out, re.MULTILINE) for name in NAMES)


def test_help_needs_nothing_heavy() -> None:
    done = marcha_process("--help", code="import atexit; atexit.register(lambda: print(sorted(sys.modules)))")
    loaded = {name.split(".")[0] for name in re.findall(r"'([\w.]+)'", done.out.splitlines()[-1])}
    assert not loaded & set(HEAVY)


def test_version_is_the_distributions() -> None:
    from importlib.metadata import version

    assert marcha("--version").out.strip() == version("marcha")


@pytest.mark.parametrize("command", LEAVES, ids=" ".join)
def test_every_command_explains_itself_and_takes_json(command: tuple[str, ...]) -> None:
    done = marcha(*command, "--help")
    assert done.code == 0
    assert "--json" in done.out
    assert "Exit codes" in done.out


@pytest.mark.parametrize("entry", COMMANDS, ids=NAMES)
def test_summaries_are_the_first_lines_of_the_docstrings(entry: tuple[object, str, str, str]) -> None:
    _, _, target, summary = entry
    module, _, name = target.partition(":")
    found = getattr(import_module(f"marcha.cli.{module}"), name)
    assert (found.help if name == "app" else found.__doc__).splitlines()[0] == summary


def test_the_reference_page_is_current() -> None:
    """Write it anew with ``python -m marcha.cli.reference > docs/cli.md``."""
    assert (ROOT / "docs" / "cli.md").read_text(encoding="utf-8") == page()


# -- wrong usage ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments",
    [
        ("no-such-command",),
        ("info",),
        ("info", "a.mcap", "b.mcap"),
        ("info", "a.mcap", "--no-such-option"),
        ("convert", "-o", "a.mcap"),
        ("convert", "a.csv"),
        ("replay", "a.mcap"),
        ("simulate", "rectangle", "-o", "x", "--seed", "seven"),
        ("simulate", "rectangle", "-o", "x", "--set", "length_m"),
        ("simulate", "rectangle", "-o", "x", "--set", "no_such_option=1"),
        ("simulate", "no-such-scenario", "-o", "x"),
        ("simulate", "rectangle", "-o", "x", "--set", "seed=3"),
        ("view",),
        ("view", "a.mcap", "--web", "--rrd", "a.rrd"),
    ],
    ids=" ".join,
)
def test_wrong_usage_exits_with_2_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    done = marcha(*arguments)
    assert done.code == 2
    assert done.complaint
    assert list(tmp_path.iterdir()) == []


def test_wrong_usage_is_json_too() -> None:
    done = marcha("info", "--json")
    assert done.document["exit_code"] == 2
    assert "marcha info --help" in done.document["error"]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    columns = {f"{s}_{a}": [0.0] * 300 for s in ("acc", "gyr") for a in "xyz"}
    table = pl.DataFrame({"t_ns": [10**9 + 10**7 * k for k in range(300)], **columns})
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_table("/imu", "sensor_msgs/msg/Imu", table)
    return tmp_path / "a.mcap"


@pytest.mark.parametrize(
    "options",
    [
        ("-e", "no.such"),
        ("-e", "foot.9iez", "-p", "no_such=1"),
        ("-e", "foot.9iez[sigma_acc=-1]"),
        ("-e", "foot.9iez", "--input", "/no/such"),
        ("-e", "foot.9iez", "--from", "yesterday"),
        ("-e", "foot.9iez", "--speed", "fast"),
    ],
    ids=lambda o: " ".join(o),
)
def test_wrong_options_of_replay(recording: Path, options: tuple[str, ...]) -> None:
    done = marcha("replay", recording, *options)
    assert done.code == 2
    assert done.complaint


def test_a_bug_shows_its_traceback(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contents, "channel_entries", lambda rec: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        marcha("info", recording)


def test_an_interrupt_exits_with_130(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(rec: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(contents, "channel_entries", interrupted)
    done = marcha("info", recording, "--json")
    assert done.code == 130
    assert "interrupted" in done.complaint


def test_a_warning_is_one_line(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        contents, "channel_entries", lambda rec: warnings.warn("first\nsecond", stacklevel=1) or []
    )
    done = marcha("info", recording, "--json")
    assert done.code == 0
    assert done.err == "marcha: warning: first second\n"


@pytest.mark.skipif(os.name != "posix", reason="needs a shell's pipe")
def test_a_reader_that_goes_away_is_no_bug(recording: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "marcha.cli", "formats"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert "Traceback" not in process.stderr.read().decode()
    process.stderr.close()
    assert process.wait(60) == 1


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_script_knows_the_commands(shell: str) -> None:
    script = marcha("completion", shell).out
    assert "replay" in script
    assert "marcha" in script


def test_completion_is_installed_for_the_user(tmp_path: Path) -> None:
    if os.name != "posix":
        pytest.skip("installs into a POSIX home")
    done = marcha_process(
        "completion",
        "fish",
        "--install",
        "--json",
        code=f"import os; os.environ.update(HOME={str(tmp_path)!r})",
    )
    path = Path(done.document["path"])
    assert path.is_relative_to(tmp_path)
    assert "replay" in path.read_text()


def test_a_table_wider_than_the_terminal_is_folded() -> None:
    table = TextTable(
        ["metric", ">first_run", ">second_run", ">third"], [["closure_m", 1.5, 2.0, 33.0]], fold=True
    )
    pieces = folded(table, 24)
    assert [list(p.columns) for p in pieces] == [
        ["metric", ">first_run"],
        ["metric", ">second_run"],
        ["metric", ">third"],
    ]
    assert [list(p.rows[0]) for p in pieces] == [["closure_m", 1.5], ["closure_m", 2.0], ["closure_m", 33.0]]
    assert folded(table, 80) == [TextTable(table.columns, [list(table.rows[0])])]


# -- progress and colour ----------------------------------------------------------------------------


@pytest.mark.skipif(os.name != "posix", reason="needs a pseudo-terminal")
@pytest.mark.parametrize("colour", [True, False])
def test_bars_and_colour_only_on_a_terminal(recording: Path, colour: bool) -> None:
    import pty

    main_end, terminal = pty.openpty()
    environment = {k: v for k, v in os.environ.items() if k != "NO_COLOR"} | {"TERM": "xterm"}
    process = subprocess.Popen(
        [sys.executable, "-m", "marcha.cli", "info", str(recording)],
        stdout=terminal,
        env=environment if colour else environment | {"NO_COLOR": "1"},
    )
    os.close(terminal)
    seen = b""
    while True:
        try:
            chunk = os.read(main_end, 4096)
        except OSError:  # the other end was closed
            break
        if not chunk:
            break
        seen += chunk
    assert process.wait(60) == 0
    assert b"/imu" in seen
    assert (b"\x1b[3" in seen) is False  # no colours at all: weight marks the heading
    assert b"\x1b[1m" in seen


def test_nothing_but_text_in_a_pipe(recording: Path) -> None:
    done = marcha_process("replay", recording, "-e", "foot.naive")
    assert "\x1b" not in done.out + done.err


# -- values -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("0", 10**9),
        ("12.5", 13_500_000_000),
        ("12.5s", 13_500_000_000),
        ("1m", 61 * 10**9),
        ("1min", 61 * 10**9),
        ("1h", 3601 * 10**9),
        ("500ms", 1_500_000_000),
        ("1us", 10**9 + 1000),
        ("7ns", 10**9 + 7),
        ("-1s", 0),
        ("1e1", 11 * 10**9),
        ("@1700000000123456789", 1_700_000_000_123_456_789),
        ("@2s", 2 * 10**9),
    ],
)
def test_moments(recording: Path, text: str, ns: int) -> None:
    assert instant(text, mr.open(recording), "--from") == ns


@pytest.mark.parametrize("text", ["", "soon", "1d", "1 s s", "@", "nan", "1,5", "--"])
def test_what_is_no_moment(recording: Path, text: str) -> None:
    with pytest.raises(UsageError, match="--from"):
        instant(text, mr.open(recording), "--from")


@given(ns=st.integers(0, 2**62))
def test_every_nanosecond_can_be_named(ns: int) -> None:
    assert instant(f"@{ns}", None, "--from") == ns  # type: ignore[arg-type]


@given(st.dictionaries(st.text("abc_", min_size=1, max_size=5), st.text("abc=.1-é", max_size=9), max_size=4))
def test_settings_are_read_as_written(pairs: dict[str, str]) -> None:
    assert settings(tuple(f"{k}={v}" for k, v in pairs.items()), "--set") == pairs


def test_settings_given_twice_must_agree() -> None:
    assert settings(("a=1", "a=1"), "--set") == {"a": "1"}
    with pytest.raises(UsageError, match="given twice"):
        settings(("a=1", "a=2"), "--set")


@given(st.floats(allow_nan=False))
def test_limits_are_numbers(value: float) -> None:
    assert limits((f"rmse_deg={value!r}",), "--max") == {"rmse_deg": value}


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (float("nan"), "–"),
        (3, "3"),
        (123456789, "123456789"),
        (0.0123456, "0.01235"),
        (98765.4, "98765"),
        (True, "yes"),
        ("foot.9iez[sigma_acc=0.1]", "foot.9iez[sigma_acc=0.1]"),
    ],
)
def test_cells(value: object, text: str) -> None:
    assert number(value) == text


def test_before_the_first_sample_the_bar_says_what_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = io.StringIO()
    monkeypatch.setattr(terminal, "isatty", lambda: True)
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress("replay", DEFAULT, before="estimators are compiled") as report:
        assert report is not None
        assert "estimators are compiled" in terminal.getvalue()
        report(30, 100)
    assert "30 %" in terminal.getvalue()
