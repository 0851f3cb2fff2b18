"""The fuzzer sees all that is registered and notices what it must; ``.ci/run`` lets it look (``make fuzz``)."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from marcha.ingest import registry

from .fuzz import mcap, mutators, seeds
from .fuzz.run import Result, generator, report, run_all
from .fuzz.server import Failure, Verdict, in_child, scratch, together
from .fuzz.targets import Target

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that fork")


def test_every_registered_importer_has_a_sample() -> None:
    assert seeds.without_sample() == []
    assert {c.importer.name for c in seeds.contracts()} == set(registry.importers())


def test_every_registered_exporter_is_a_target() -> None:
    from marcha.export import available

    from .fuzz.targets import targets

    sound = seeds.Seeds([], {"example": b"", "walk": b""}, {}, {}, {})
    assert {f"export {name}" for name in available()} <= {t.name for t in targets(sound)}


def test_what_a_killed_fuzzer_left_the_next_one_removes() -> None:
    pid = os.fork()
    if pid == 0:
        with scratch() as folder:
            (folder / "input").mkdir()
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(pid, 0)
    with scratch() as folder:
        left = list(folder.parent.glob(f"marcha-{pid}-*"))
        assert folder.is_dir()
    assert left == []
    assert not folder.exists()


def endless() -> None:
    while True:
        pass


def hungry() -> None:
    _ = [bytearray(1 << 20) for _ in range(700)]
    time.sleep(0)


def crash() -> None:
    os.abort()


def broken() -> None:
    raise KeyError("t")


def refused() -> None:
    raise Failure("value", "12 rows")


@pytest.mark.parametrize(
    ("task", "kind"),
    [
        (endless, "hang"),
        (hungry, "memory"),
        (crash, "crash"),
        (broken, "traceback"),
        (refused, "value"),
        (dict, ""),
    ],
)
def test_what_no_input_may_do_is_noticed(task: Callable[[], object], kind: str) -> None:
    _, verdict = in_child(task, cpu_s=1 if task is endless else 20, memory=300_000_000)
    assert verdict.kind == kind
    assert isinstance(verdict, Verdict)


@pytest.mark.parametrize("task", [crash, broken, refused])
def test_tasks_in_one_process_end_with_the_first_that_fails(task: Callable[[], object]) -> None:
    went_well, said = together([dict, dict, task, dict])
    assert len(went_well) == 2
    assert said
    assert len(together([dict, dict])[0]) == 2
    assert together([task, dict])[0] == []


def test_what_inputs_before_it_hold_is_not_counted_against_an_input() -> None:
    """Modules that commands of earlier inputs had loaded once took the limit of later ones: a failure after others."""
    kept: list[bytes] = []
    went_well, said = together([lambda: kept.append(b"x" * 300_000_000)] * 3)
    assert len(went_well) == 3, said
    went_well, said = together([dict, lambda: kept.append(b"x" * 600_000_000)])
    assert len(went_well) == 1
    assert said.startswith("memory")


def test_a_failure_among_others_is_that_of_its_input(tmp_path: Path) -> None:
    """Numbers 5 and 17 fail in different ways, 9 only where another ran before it in the same process."""
    ran: list[int] = []

    def act(rng: np.random.Generator, folder: Path) -> None:
        drawn = rng.random()
        number = next(n for n in range(40) if generator(7, "t", n).random() == drawn)
        assert not list(folder.iterdir())
        (folder / "in").write_bytes(b"x")
        if number == 5:
            os.abort()
        if number == 17:
            raise KeyError("t")
        if number == 9 and ran:
            raise ValueError
        ran.append(number)

    result = Result()
    run_all(result, [Target("t", act)], range(40), tmp_path, seed=7)
    assert result.inputs == 40
    assert {f.number: f.verdict.kind for f in result.failed.values()} == {
        5: "crash",
        17: "traceback",
        9: "only after others",
    }


def test_the_same_number_gives_the_same_input() -> None:
    data = b"t,x\n" + b"".join(b"%d,%d\n" % (k, k * k) for k in range(100))
    first, second = (mutators.text(np.random.default_rng(4), data) for _ in "ab")
    assert first == second


def test_rows_that_a_mutation_touches_are_counted() -> None:
    rng, data = np.random.default_rng(0), b"t,x\n" + b"".join(b"%d,%d\n" % (k, k * k) for k in range(300))
    lines = set(data.splitlines())
    for _ in range(300):
        done = mutators.text(rng, data)
        if done.rows is not None:
            assert len(set(done.data.splitlines()) - lines) <= done.rows, done.what


def test_records_are_taken_apart_and_put_together_again(tmp_path: Path) -> None:
    from .contracts.exporter import example

    data = example(tmp_path / "a.mcap", 50).read_bytes()
    assert mcap.whole(mcap.records(data)) == data


def test_a_failure_names_what_reproduces_it(tmp_path: Path) -> None:
    result = Result()
    for number in (3, 9):
        result.add("import a", number, Verdict("traceback", 'File "/x/ingest/a.py", line 7\nKeyError: 1'))
    with (tmp_path / "said.txt").open("w") as out:
        report(result, 5, file=out)
    said = (tmp_path / "said.txt").read_text()
    assert "2 × traceback ingest/a.py:7" in said
    assert "--only 'import a' --seed 5 --first 3" in said
    assert json.dumps(result.failures) == "2"
