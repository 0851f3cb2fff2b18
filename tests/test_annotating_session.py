"""Annotating by eye, below the page: edits, undo, drafts, saves and kills; signals at every zoom; who may ask."""

from __future__ import annotations

import http.client
import json
import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.recording import MarchaError, Recording, UsageError
from marcha.recording.changes import change, history, undo
from marcha.recording.events import Vocabulary
from marcha.viz.annotating.pyramid import BLOCK, FACTOR, TILE, Pyramid
from marcha.viz.annotating.server import PageServer
from marcha.viz.annotating.session import Session
from marcha.viz.annotating.signals import Signals

from .annotation_samples import START_NS, hard_annotations, recording

S = 10**9


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return recording(tmp_path / "walk.mcap")


def session(path: Path, by: str = "eva") -> Session:
    return Session(mr.open(path), path, by=by, overwrite=True, action="page")


def mark(label: str, start_s: float, end_s: float | None = None, **more: object) -> dict[str, Any]:
    start, end = (START_NS + round(t * S) for t in (start_s, start_s if end_s is None else end_s))
    return {"tier": "t", "start_ns": start, "end_ns": end, "label": label, **more}


def stored(path: Path) -> dict[str, dict[str, Any]]:
    return {row["id"]: row for row in mr.open(path).annotations.to_dicts()}


def test_what_is_saved_is_what_was_marked_and_one_change_that_can_be_undone(path: Path) -> None:
    work = session(path)
    first = work.edit([mark("a", 1, 2), mark("b", 5)]).added
    work.edit([{**first[0], "end_ns": first[0]["end_ns"] + S}], [first[0]["id"]])
    work.edit((), [first[1]["id"]])
    assert work.unsaved == 1
    entry = work.save()
    assert entry is not None
    assert (entry.action, entry.by, len(entry.added), entry.removed) == ("page", "eva", 1, ())
    assert stored(path) == work.rows
    assert (work.unsaved, work.draft.exists(), work.save()) == (0, False, None)
    assert work.rows[first[0]["id"]]["source"] == "human:eva"
    undo(mr.open(path), path, overwrite=True)
    assert mr.open(path).annotations.height == 0


def test_undo_goes_back_over_a_save(path: Path) -> None:
    work = session(path)
    work.edit([mark("a", 1, 2)])
    work.save()
    work.undo()
    assert (work.rows, work.unsaved) == ({}, 1)
    work.save()
    assert stored(path) == {}
    work.redo()
    work.save()
    assert [r["label"] for r in stored(path).values()] == ["a"]
    assert len(history(mr.open(path))) == 3


def test_a_long_session_undone_and_redone_equals_its_table(path: Path) -> None:
    work, rng = session(path), random.Random(3)
    states = [dict(work.rows)]
    for k in range(200):
        ids = list(work.rows)
        if ids and rng.random() < 0.3:
            row = work.rows[rng.choice(ids)]
            new = [] if rng.random() < 0.5 else [{**row, "label": f"{k}"}]
            work.edit(new, [row["id"]])
        else:
            work.edit([mark(f"m{k}", k, k + rng.random() * 9)])
        states.append(dict(work.rows))
    for state in reversed(states[:-1]):
        work.undo()
        assert work.rows == state
    assert work.undo().added == ()
    for state in states[1:]:
        work.redo()
        assert work.rows == state
    work.save()
    assert stored(path) == states[-1]


def test_a_draft_brings_back_what_was_not_saved(path: Path) -> None:
    work = session(path)
    work.edit([mark("a", 1, 2)])
    work.save()
    work.edit([mark("b", 3)])
    work.edit([mark("c", 4)])
    work.undo()
    with work.draft.open("ab") as file:
        file.write(b'{"added": [{"tier": "t"')  # killed while it wrote
    again = session(path)
    assert again.taken_up == 3
    assert again.rows == work.rows
    assert {r["label"] for r in again.rows.values()} == {"a", "b"}
    again.undo()
    assert {r["label"] for r in again.rows.values()} == {"a", "b", "c"}
    again.save()
    assert not again.draft.exists()


def test_a_draft_that_does_not_fit_is_named_and_kept(path: Path) -> None:
    work = session(path)
    work.edit([mark("a", 1, 2)])
    work.draft.write_text(work.draft.read_text().replace(str(START_NS + S), "5"))
    with pytest.raises(MarchaError, match=r"draft\.jsonl: line 1: .* does not fit .*; move that file away"):
        session(path)
    assert work.draft.exists()


def test_what_another_program_added_meanwhile_stays(path: Path) -> None:
    work = session(path)
    work.edit([mark("mine", 1, 2)])
    change(mr.open(path), path, add=pl.DataFrame([mark("theirs", 3)]), overwrite=True)
    work.save()
    assert {r["label"] for r in stored(path).values()} == {"mine", "theirs"}
    assert work.rows == stored(path)


def test_edits_made_while_a_save_runs_are_kept(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from marcha.viz.annotating import session as module

    work = session(path)
    work.edit([mark("a", 1, 2), mark("b", 2, 3)])
    gone = next(iter(work.rows))

    def during(*args: Any, **kw: Any) -> Any:
        work.edit([mark("late", 7)], [gone])
        return change(*args, **kw)

    monkeypatch.setattr(module, "change", during)
    work.save()
    assert {r["label"] for r in stored(path).values()} == {"a", "b"}
    assert ({r["label"] for r in work.rows.values()}, work.unsaved) == ({"b", "late"}, 2)
    assert session(path).rows == work.rows
    monkeypatch.undo()
    work.save()
    assert stored(path) == work.rows


def test_what_an_algorithm_said_becomes_the_user_s_when_it_is_moved(path: Path) -> None:
    work = session(path)
    (row,) = work.edit([mark("turn", 1, 2, source="algorithm:rule.turn@1", confidence=0.5)]).added
    work.edit([{**row, "note": "seen"}], [row["id"]])
    assert work.rows[row["id"]]["source"] == "algorithm:rule.turn@1"
    work.edit([{**row, "end_ns": row["end_ns"] + 1}], [row["id"]])
    assert work.rows[row["id"]]["source"] == "human:eva"


def test_bad_edits_are_one_line_and_change_nothing(path: Path) -> None:
    change(mr.open(path), path, vocabulary={"t": Vocabulary(labels={"ok": ""}, closed=True)}, overwrite=True)
    work = session(path)
    (row,) = work.edit([mark("ok", 1, 2)]).added
    bad: list[tuple[list[Any], list[str], str]] = [
        ([mark("ok", -5, 2)], [], "lie outside of the recording"),
        ([mark("ok", 3, 2)], [], "is no interval"),
        ([mark("what", 1)], [], "not in its closed vocabulary; it has ok"),
        ([mark("ok", 1, id=row["id"])], [], "is taken"),
        ([], ["gone"], "there is no annotation 'gone' any more"),
        ([{"tier": "t"}], [], "annotation"),
        ([mark("ok", 1, confidence=3.0)], [], "is not between 0"),
    ]
    before = dict(work.rows), work.revision, work.draft.read_bytes()
    for add, remove, words in bad:
        with pytest.raises(MarchaError) as raised:
            work.edit(add, remove)
        assert words in str(raised.value)
        assert "\n" not in str(raised.value)
    assert (work.rows, work.revision, work.draft.read_bytes()) == before


def test_an_output_that_exists_is_refused_before_anything_is_marked(path: Path, tmp_path: Path) -> None:
    recording(tmp_path / "b.mcap")
    with pytest.raises(UsageError, match="exists"):
        Session(mr.open(path), tmp_path / "b.mcap", action="page")


KILLED = """
import os, signal, sys
from pathlib import Path
import marcha.recording as mr
from marcha.recording.atomic import AtomicFile
from marcha.viz.annotating.session import Session
path, when = Path(sys.argv[1]), sys.argv[2]
work = Session(mr.open(path), path, by="eva", overwrite=True, action="page")
count = 0
def wrapped(old, first):
    def call(self, *args):
        global count
        count += 1
        if first and (when == old.__name__ or when == f"write {count}"):
            os.kill(os.getpid(), signal.SIGKILL)
        done = old(self, *args)
        if when == f"after {old.__name__}":
            os.kill(os.getpid(), signal.SIGKILL)
        return done
    return call
AtomicFile.write = wrapped(AtomicFile.write, True)
AtomicFile.commit = wrapped(AtomicFile.commit, True)
print("saving", flush=True)
work.save()
"""


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize("when", ["write 1", "write 9", "commit", "after commit"])
def test_killed_during_a_save_there_is_the_old_or_the_new_recording(path: Path, when: str) -> None:
    change(mr.open(path), path, add=hard_annotations(50), overwrite=True)
    old = stored(path)
    work = session(path)
    work.edit([mark("new", 1, 2)], list(old)[:20])
    done = subprocess.run([sys.executable, "-c", KILLED, path, when], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (-signal.SIGKILL, "saving\n"), done.stderr
    assert stored(path) == (work.rows if when == "after commit" else old)
    if when != "after commit":
        again = session(path)
        assert again.rows == work.rows
        again.save()
    assert stored(path) == work.rows


# ---------------------------------------------------------------------------------------------------- signals


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    rng = np.random.default_rng(5)
    n = 70_001
    t = START_NS + np.arange(n) * 10**7
    t[n // 2 :] += 50 * S
    value = rng.normal(size=n)
    value[1000:1100] = np.nan
    path = tmp_path_factory.mktemp("long") / "long.mcap"
    with mr.create(path) as out:
        for at in range(0, n, 9_999):
            cut = slice(at, at + 9_999)
            rows = {"t_ns": t[cut], "lat_deg": 38.7 + value[cut] * 1e-6, "lon_deg": -9.1, "alt_m": value[cut]}
            out.add_table("/phone/gnss", "sensor_msgs/msg/NavSatFix", pl.DataFrame(rows))
    return mr.open(path)


def test_every_level_has_the_extremes_of_its_rows(long: Recording) -> None:
    columns = ["lat_deg", "alt_m"]
    pyramid = Pyramid(long, long.channels["/phone/gnss"], columns)
    pyramid.build()
    table = long.table("/phone/gnss")
    values = table.select(columns).to_numpy().T
    t_ns = table["t_ns"].to_numpy()
    width = BLOCK
    for level, size in enumerate(pyramid.sizes, 1):
        edges = np.arange(0, table.height, width)
        assert size == len(edges)
        tiles = [pyramid.tile(level, k) for k in range(-(-size // TILE))]
        assert np.array_equal(np.concatenate([t.first_ns for t in tiles]), t_ns[edges])
        ends = np.append(edges[1:], table.height) - 1
        assert np.array_equal(np.concatenate([t.last_ns for t in tiles]), t_ns[ends])
        for k, origin in enumerate(pyramid.origin):
            low = np.concatenate([t.low[k] for t in tiles]).astype(float)
            high = np.concatenate([t.high[k] for t in tiles]).astype(float)
            expected = (
                np.fmin.reduceat(values[k] - origin, edges),
                np.fmax.reduceat(values[k] - origin, edges),
            )
            np.testing.assert_allclose(low, expected[0], rtol=1e-6, atol=1e-12)
            np.testing.assert_allclose(high, expected[1], rtol=1e-6, atol=1e-12)
        width *= FACTOR
    assert pyramid.sizes[-1] <= 4096
    assert pyramid.overview().first_ns.size == pyramid.sizes[-1]


def test_rows_are_those_of_the_file(long: Recording) -> None:
    pyramid = Pyramid(long, long.channels["/phone/gnss"], ["lat_deg"])
    pyramid.build()
    table = long.table("/phone/gnss")
    tiles = [pyramid.tile(0, k) for k in range(-(-table.height // TILE))]
    assert np.array_equal(np.concatenate([t.first_ns for t in tiles]), table["t_ns"].to_numpy())
    shown = np.concatenate([t.low[0] for t in tiles]).astype(float) + pyramid.origin[0]
    np.testing.assert_allclose(shown, table["lat_deg"].to_numpy(), rtol=0, atol=1e-12, equal_nan=True)
    assert pyramid.tile(0, 1000).first_ns.size == 0


def test_panels_hold_columns_of_one_unit(long: Recording) -> None:
    signals = Signals(long)
    signals.close()
    found = {p["name"]: (p["unit"], [c["column"] for c in p["columns"]]) for p in signals.panels}
    assert found["alt_m"] == ("m", ["alt_m"])
    assert found["lat_deg"] == ("°", ["lat_deg"])
    assert any(p["open"] for p in signals.panels)


# ----------------------------------------------------------------------------------------------------- server


@pytest.fixture
def server(path: Path) -> Iterator[PageServer]:
    with PageServer(session(path)) as running:
        yield running


def ask(
    server: PageServer, path: str, body: object = None, **headers: str
) -> tuple[int, Any, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    data = None if body is None else json.dumps(body).encode()
    connection.request("GET" if data is None else "POST", path, data, headers)
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    is_json = answer.headers["Content-Type"] == "application/json"
    return answer.status, json.loads(content) if is_json else content, dict(answer.headers)


def test_only_who_has_the_token_and_names_this_machine_is_answered(server: PageServer) -> None:
    token = {"X-Marcha-Token": server.token}
    assert ask(server, "/api/recording", **token)[0] == 200
    assert ask(server, "/api/recording")[0] == 403
    assert ask(server, "/api/recording", **{"X-Marcha-Token": "x"})[0] == 403
    assert ask(server, "/api/recording", **{"X-Marcha-Token": "ÿ"})[0] == 403
    assert ask(server, "/api/recording", Host=f"evil.example:{server.port}", **token)[0] == 403
    edit = {"add": [{"tier": "t", "label": "x", "start_ns": 0, "end_ns": 0}]}
    assert ask(server, "/api/edit", edit)[0] == 403
    assert ask(server, f"/api/edit?token={server.token}", edit)[0] == 403  # a form of another page could
    assert server.session.rows == {}
    assert ask(server, "/api/edit", edit, **token)[0] == 200
    assert len(server.session.rows) == 1


def test_the_page_may_load_nothing_from_elsewhere_and_no_other_file_is_given(server: PageServer) -> None:
    status, page, headers = ask(server, "/")
    assert (status, b"<canvas" in page) == (200, True)
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert "unsafe" not in headers["Content-Security-Policy"]
    for name in ("/app.js", "/style.css"):
        assert ask(server, name)[0] == 200
    for name in ("/../server.py", "/..%2fserver.py", "/server.py", "/nothing.js"):
        assert ask(server, name)[0] in (403, 404)


def test_what_is_asked_wrongly_is_answered_in_one_line(server: PageServer) -> None:
    token = {"X-Marcha-Token": server.token}
    for path, body in (
        ("/api/tile?topic=/imu&level=9&index=0", None),
        ("/api/tile?topic=/none&level=0&index=0", None),
        ("/api/tile?topic=/imu", None),
        ("/api/edit", {"add": [{"tier": "t", "label": "x", "start_ns": "a", "end_ns": 0}]}),
        ("/api/edit", {"add": [{"tier": "t", "label": "x", "start_ns": -1, "end_ns": 0}]}),
        ("/api/edit", {"add": 5}),
        ("/api/edit", [1]),
    ):
        status, said, _ = ask(server, path, body, **token)
        assert status == 400, (path, body)
        assert said["error"]
        assert "\n" not in said["error"]
    assert server.session.rows == {}


def test_a_page_that_does_not_know_the_newest_state_is_given_all_of_it(server: PageServer) -> None:
    token = {"X-Marcha-Token": server.token}
    edit = {"add": [{"tier": "t", "label": "x", "start_ns": 0, "end_ns": 5}], "revision": 0}
    _, first, _ = ask(server, "/api/edit", edit, **token)
    assert [r["end_ns"] for r in first["added"]] == [5]
    _, second, _ = ask(server, "/api/edit", edit, **token)
    assert len(second["annotations"]) == 2


@pytest.mark.skipif(os.name != "posix", reason="signals")
@pytest.mark.parametrize(("ending", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_program_ends_by_ctrl_c_and_says_what_is_not_saved(
    path: Path, ending: signal.Signals, code: int
) -> None:
    run = "import sys; from marcha.cli import main; sys.exit(main(sys.argv[1:]))"
    command = [sys.executable, "-c", run, "annotate", str(path), "--page", "--no-browser", "--in-place"]
    program = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert program.stderr is not None
    address = program.stderr.readline().split()[5].rstrip(";")
    port, token = address.split(":")[2].split("/")[0], address.partition("token=")[2]
    connection = http.client.HTTPConnection("127.0.0.1", int(port), timeout=10)
    for name, at in (("edit", 1), ("save", 0), ("edit", 2)):
        row = {"tier": "t", "label": "x", "start_ns": at * S, "end_ns": at * S}
        connection.request("POST", f"/api/{name}", json.dumps({"add": [row]}), {"X-Marcha-Token": token})
        assert connection.getresponse().read()
    connection.close()
    program.send_signal(ending)
    out, err = program.communicate(timeout=30)
    assert program.returncode == code
    assert err.startswith("marcha: 1 annotations are not saved; ")
    assert out == (f"{path}: 2 annotations, 1 not saved\n" if code == 130 else "")
    assert len(stored(path)) == 1
    assert len(session(path).rows) == 2
