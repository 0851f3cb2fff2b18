"""A study's configuration: what is refused, what the grid is, which cells are the same."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from marcha.recording import UsageError
from marcha.study import load, presets
from marcha.study.config import StudyConfig, configuration, factor_names, methods, truth
from marcha.study.plan import StudyRecording, find_sources, jobs, tasks

MINIMAL = """
[recordings]
[[estimators]]
name = "foot.naive"
"""


def parse(text: str, folder: Path) -> StudyConfig:
    path = folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    return load(path)[0]


def test_lists_of_parameters_span_a_grid(tmp_path: Path) -> None:
    text = (
        MINIMAL
        + 'label = "N"\nparams = { sigma_acc = [0.1, 0.2], gravity = 9.8 }\nfactors.detector = ["shoe", "are"]'
    )
    grid = methods(parse(text, tmp_path))
    assert [(m.label, m.levels["detector"]) for m in grid] == [
        ("N sigma_acc=0.1", "shoe"),
        ("N sigma_acc=0.1", "are"),
        ("N sigma_acc=0.2", "shoe"),
        ("N sigma_acc=0.2", "are"),
    ]
    assert grid[0].params == {"sigma_acc": 0.1, "gravity": 9.8, "detector": "shoe"}


def test_presets_of_an_estimator_are_variants(tmp_path: Path) -> None:
    grid = methods(parse(MINIMAL + 'presets = ["", "tuned"]', tmp_path))
    assert [(m.label, m.preset) for m in grid] == [("foot.naive", ""), ("foot.naive tuned", "tuned")]


def test_a_configuration_is_read_without_importing_its_estimators() -> None:
    code = """if True:
        import sys
        from marcha.study import load
        load("foot-simulated")
        print([m for m in sys.modules if m.startswith(("numba", "marcha.algorithms.foot.core"))])"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_level_may_be_a_preset_that_sets_the_parameter(tmp_path: Path) -> None:
    text = MINIMAL.replace("foot.naive", "foot.9iez") + 'factors = { detector = ["shoe", "shoe-tuned"] }\n'
    plain, tuned = methods(parse(text + 'presets = ["device"]', tmp_path))
    assert (plain.levels["detector"], tuned.levels["detector"]) == ("shoe", "shoe-tuned")
    assert (plain.preset, tuned.preset) == ("device", "device")
    assert plain.params == {"detector": "shoe"}
    assert tuned.params == {"detector": "shoe", "shoe_max": 1e5}


def test_any_parameters_are_factors_and_levels_keep_their_type(tmp_path: Path) -> None:
    text = "[factors]\nsigma_acc = [0.1, 0.2]\nhupt = [false, true]\n" + MINIMAL.replace(
        "foot.naive", "foot.9iez"
    )
    text += '[[estimators]]\nname = "foot.naive"\nfactors = { hupt = [], sigma_acc = [0.3] }\n'
    config = parse(text, tmp_path)
    grid = methods(config)
    assert factor_names(config) == ("sigma_acc", "hupt")
    assert [tuple(m.levels.values()) for m in grid[:2]] == [("0.1", "False"), ("0.1", "True")]
    assert grid[1].params == {"sigma_acc": 0.1, "hupt": True}
    assert (len(grid), grid[4].levels, grid[4].params) == (
        5,
        {"sigma_acc": "0.3", "hupt": ""},
        {"sigma_acc": 0.3},
    )


def test_scenarios_are_told_apart_and_rules_are_searched_in_a_walks_configuration() -> None:
    config, _ = load("foot-consistency")
    sources, _ = find_sources(config, None, "code")
    assert {s.configuration for s in sources} >= {"rectangle C33", "straight C33"}
    assert configuration(config, "straight C33", "/foot/imu2") == "straight, sensor 2"


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ("colour = 1", "unknown field `colour`"),
        ("params = { a = [] }", "parameter a has an empty list"),
        ('params = { detector = "shoe" }\nfactors = { detector = ["are"] }', "give `detector` either"),
        ('factors = { filter = ["a"] }', "is the name of a column"),
        (
            '[[metrics]]\ncolumn = "EP"\n[[published]]\nmetric = "EP"\norigin = ""\nrows = {}\nby = "detector"',
            "nor a factor of this study",
        ),
        ('[[estimators]]\nname = "foot.naive"', "occurs twice"),
        ('[[configurations]]\npattern = "("\nlabel = "x"', "is no regular expression"),
        ("[[configurations]]\npattern = 'a(b)'\nlabel = '\\2'", "does not fit pattern"),
        ("[statistics]\nconfidence = 2.0", "`float` < 1.0"),
        ('[[published]]\nmetric = "EP"\norigin = ""\nrows = {}', "metric 'EP' is none of"),
        ("[[metrics]]\ncolumn = 'a'\n[[metrics]]\ncolumn = 'a'", "occurs twice"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_file(tmp_path: Path, extra: str, words: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse(MINIMAL + extra, tmp_path)
    message = str(caught.value)
    assert message.startswith(str(tmp_path))
    assert words in message
    assert "\n" not in message


def test_a_study_needs_something_to_study(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="nothing to study"):
        parse('[[estimators]]\nname = "foot.naive"', tmp_path)


def test_an_unknown_preset_lists_what_there_is() -> None:
    with pytest.raises(UsageError, match="foot-tables"):
        load("foot-table")


@pytest.mark.parametrize("name", presets())
def test_presets_load_and_their_methods_have_names_of_their_own(name: str) -> None:
    config, base = load(name)
    names = [(m.label, *m.levels.values()) for m in methods(config)]
    assert base is None
    assert len(names) == len(set(names))


def test_the_simulated_preset_has_480_walks() -> None:
    config, _ = load("foot-simulated")
    sources, _ = find_sources(config, None, "code")
    assert len(sources) * len(methods(config)) == 480
    assert len({s.seed for s in sources}) == len(sources)


def test_foot_tables_knows_configurations_of_both_sensors() -> None:
    config, _ = load("foot-tables")
    assert configuration(config, "conf-0312-coleta.csv", "/foot/imu1") == "C03"
    assert configuration(config, "conf-0312-coleta.csv", "/foot/imu2") == "C12"
    assert configuration(config, "walk.csv", "/foot/imu1") == "other"


def test_published_means_are_those_of_the_source() -> None:
    config, _ = load("foot-tables")
    tables = {(t.table, t.metric): t for t in config.published}
    assert {t for t, _ in tables} == {"5", "6", "7", "8", "9"}
    assert tables["5", "EP"].rows["15IEZ+ZARU"]["C33"] == 0.00982
    assert tables["6", "ED, raw path"].rows["9IEZ+MAD"]["C30"] == 1.73145
    assert tables["7", "EA"].rows["9IEZ+KF"]["C03"] == 0.78824
    assert tables["8", "run time"].rows["9IEZ"]["C00"] == 1.24708
    assert tables["9", "EP"].sd["pitch"]["C33"] == 0.00227


def test_the_first_rule_of_truth_that_fits_counts(tmp_path: Path) -> None:
    text = """
    [recordings]
    truth = [{ pattern = "^loop", closed = true, length_m = 22.1 }, { length_m = 10.0 }]
    [[estimators]]
    name = "foot.naive"
    """
    recordings = parse(text, tmp_path).recordings
    assert recordings is not None
    assert truth(recordings, "loop-1.csv").closed
    assert (truth(recordings, "line.csv").closed, truth(recordings, "line.csv").length_m) == (None, 10.0)


def folder_of(tmp_path: Path, *names: str) -> Path:
    data = tmp_path / "data"
    data.mkdir()
    for name in names:
        (data / name).write_text(name, encoding="utf-8")
    return data


def test_a_recording_is_taken_for_the_raw_log_beside_it(tmp_path: Path) -> None:
    config = parse(MINIMAL, tmp_path)
    data = folder_of(tmp_path, "a.csv", "a.mcap", "b.csv", "b.truth.csv", "b.truth.toml")
    sources, notes = find_sources(config, data, "code")
    assert [(s.name, s.kind) for s in sources] == [("a", "mcap"), ("b", "raw")]
    assert "a.csv is left out" in notes[0]


def test_two_raw_logs_of_one_name_are_refused(tmp_path: Path) -> None:
    data = folder_of(tmp_path, "a.csv", "a.txt")
    with pytest.raises(UsageError, match="same name"):
        find_sources(parse(MINIMAL, tmp_path), data, "code")


def test_a_folder_without_matches_is_refused(tmp_path: Path) -> None:
    data = folder_of(tmp_path)
    with pytest.raises(UsageError, match="no file matches"):
        find_sources(parse(MINIMAL, tmp_path), data, "code")


def test_a_missing_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no such file or folder"):
        find_sources(parse(MINIMAL, tmp_path), tmp_path / "nowhere", "code")


def test_what_a_walk_knows_of_itself_counts(tmp_path: Path) -> None:
    data = folder_of(tmp_path, "a.csv", "b.csv", "b.truth.toml")
    config = parse(MINIMAL.replace("[[", "truth = [{ length_m = 22.1 }]\n[[", 1), tmp_path)
    truths = {s.name: s.truth for s in find_sources(config, data, "code")[0]}
    assert truths == {"a": {"length_m": 22.1}, "b": {}}


@pytest.mark.parametrize("change", ["content", "code", "parameter", "truth"])
def test_a_cell_is_another_one_when_anything_it_depends_on_changes(tmp_path: Path, change: str) -> None:
    data = folder_of(tmp_path, "a.csv")
    config = parse(MINIMAL, tmp_path)

    def key(config: StudyConfig, code: str = "code") -> str:
        (source,), _ = find_sources(config, data, code)
        (job,) = jobs(config, source)
        return job.key

    before, again = key(config), key(config)
    assert before == again
    if change == "content":
        (data / "a.csv").write_text("other", encoding="utf-8")
        assert key(config) != before
    elif change == "code":
        assert key(config, "other") != before
    elif change == "parameter":
        assert key(parse(MINIMAL + "params = { gravity = 9.8 }", tmp_path)) != before
    else:
        assert key(parse(MINIMAL.replace("[[", "truth = [{ closed = true }]\n[[", 1), tmp_path)) != before


def sources(count: int) -> list[StudyRecording]:
    return [StudyRecording(name=f"r{i}", kind="mcap", digest=str(i), size=100 - i) for i in range(count)]


def test_a_recording_is_read_once_for_all_its_methods(tmp_path: Path) -> None:
    config = parse(MINIMAL + "params = { gravity = [9.7, 9.8, 9.9] }", tmp_path)
    found = tasks(config, sources(8), (), tmp_path, processes=2)
    assert [len(t.jobs) for t in found] == [3] * 8


def test_few_recordings_are_split_so_that_all_processes_work(tmp_path: Path) -> None:
    config = parse(MINIMAL + f"params = {{ gravity = {[9.7 + i / 100 for i in range(16)]} }}", tmp_path)
    found = tasks(config, sources(1), (), tmp_path, processes=2)
    assert len(found) == 8
    assert sum(len(t.jobs) for t in found) == 16


def test_finished_cells_are_not_planned_again(tmp_path: Path) -> None:
    config = parse(MINIMAL + "params = { gravity = [9.7, 9.8] }", tmp_path)
    done = [j.key for s in sources(3) for j in jobs(config, s)][:3]
    found = tasks(config, sources(3), done, tmp_path, processes=1)
    assert sorted(len(t.jobs) for t in found) == [1, 2]


def test_the_resolved_configuration_reads_back_equal() -> None:
    from marcha.study.study import _plain

    config, _ = load("foot-tables")
    assert msgspec.toml.decode(msgspec.toml.encode(_plain(config)), type=StudyConfig) == config
