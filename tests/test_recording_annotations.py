"""Annotations and copies between recordings."""

from __future__ import annotations

import json
import struct

import marcha.recording as mr
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.recording.annotations import COLUMNS, FIELDS, encode_events
from marcha.recording.cdr import encode
from marcha.recording.codec import MAX_TIME_NS
from marcha.recording.definitions import load
from marcha.recording.errors import MarchaError
from marcha.recording.integrity import structure
from marcha.recording.provenance import hash_file, provenance, sources_of
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from .recording_samples import imu, sample_table, write

IMU = "sensor_msgs/msg/Imu"
TABLE = pl.DataFrame(
    {
        "tier": ["terrain", "gait", "terrain"],
        "start_ns": [5_000_000_001, 2, 1],
        "end_ns": [9_000_000_000, 2, 4],
        "label": ["stairs", "Stürzt", "flat"],
        "metadata": ['{"floor":"2"}', "{}", '{"a":"b","c":"d"}'],
    }
)


def test_annotations_read_back_by_time(tmp_path):
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_annotations(TABLE)
    rec = mr.open(tmp_path / "a.mcap")
    assert rec.annotations.select(TABLE.columns).equals(TABLE.sort("start_ns"))
    assert rec.channels["/annotation/terrain"].columns == tuple(COLUMNS)[1:]
    assert structure(rec) == []


@pytest.mark.parametrize("text", ['{"a": "x\ny"}', '{"a": "\x00"}', '{"a": 1', '{"label": "x"}', '["a"]'])
def test_metadata_that_is_no_object_of_strings_is_one_line(tmp_path, text):
    with pytest.raises(MarchaError, match="metadata") as error, mr.create(tmp_path / "a.mcap") as out:
        out.add_annotations(TABLE.with_columns(metadata=pl.lit(text)))
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_the_order_of_keys_is_that_of_the_alphabet(tmp_path):
    files = []
    for name, text in (("a", '{"b": "1", "a": "2"}'), ("b", '{"a": "2", "b": "1"}')):
        with mr.create(tmp_path / name) as out:
            out.add_annotations(TABLE.with_columns(metadata=pl.lit(text)))
        files.append((tmp_path / name).read_bytes())
    assert files[0] == files[1]


def test_others_see_foxglove_events(tmp_path):
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_annotations(TABLE)
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        events = [
            (s.name if s else "", c.topic, m.log_time, d) for s, c, m, d in reader.iter_decoded_messages()
        ]
    name, topic, log, last = events[-1]
    assert (name, topic, log) == ("foxglove_msgs/msg/Event", "/annotation/terrain", 5_000_000_001)
    assert (last.start_time.sec, last.start_time.nanosec, last.end_time.sec) == (5, 1, 9)
    assert {p.key: p.value for p in last.metadata} == {"label": "stairs", "floor": "2"}


@given(
    st.integers(0, 2**31 * 10**9 - 1),
    st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=9),
    st.dictionaries(*[st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=6)] * 2),
)
def test_events_have_the_bytes_of_the_general_encoder(start, label, pairs):
    pairs.pop("label", None)
    rows = pl.DataFrame(
        {
            "start_ns": [start, start],
            "end_ns": [start, MAX_TIME_NS],
            "label": [label, "é" + label],
            "metadata": [json.dumps(pairs), "{}"],
        }
    )
    data, index = encode_events(rows, 7)
    library = load("foxglove_msgs/msg/Event")
    begins = [*index[:, 1].tolist(), data.size]
    for i, row in enumerate(rows.to_dicts()):
        record = data[begins[i] : begins[i + 1]].tobytes()
        texts = {"label": row["label"], **json.loads(row["metadata"])}
        value = {
            **{
                f"{n}_time": {"sec": row[f"{n}_ns"] // 10**9, "nanosec": row[f"{n}_ns"] % 10**9}
                for n in ("start", "end")
            },
            "metadata": [{"key": k, "value": v} for k, v in texts.items()],
        }
        assert record[:31] == struct.pack("<BQHIQQ", 5, len(record) - 9, 7, i, start, start)
        assert record[31:] == encode(value, library["foxglove_msgs/Event"], library)


def test_annotations_of_several_chunks_read_back(tmp_path):
    numbers = range(30_000)
    rows = pl.DataFrame(
        {
            "tier": "gait",
            "start_ns": [n // 2 for n in numbers],
            "end_ns": [n + 9 for n in numbers],
            "label": [f"Schritt {n}" for n in numbers],
            "metadata": [f'{{"länge":"{n * n}"}}' for n in numbers],
        }
    )
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_annotations(rows)
    rec = mr.open(tmp_path / "a.mcap")
    assert not structure(rec)
    assert len(rec.contents.chunks) > 2
    assert rec.annotations.select(rows.columns).equals(rows)
    assert rec.annotations["id"].n_unique() == len(rows)


def test_metadata_may_be_a_struct_or_left_out(tmp_path):
    rows = TABLE.drop("metadata")
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_annotations(rows[:1].with_columns(pl.Series("metadata", [{"n": "1", "m": None}])))
        out.add_annotations(rows[1:])
    got = mr.open(tmp_path / "a.mcap").annotations
    assert [json.loads(m) for m in got["metadata"]] == [{}, {}, {"n": "1"}]


texts = st.text(st.characters(blacklist_characters="\0", blacklist_categories=["Cs"]), max_size=12)
rows = st.tuples(
    st.sampled_from(["a", "b c", "tier/deep"]),
    st.integers(0, 2**31 * 10**9 - 1),
    st.integers(0, 2**31 * 10**9 - 1),
    texts,
    st.dictionaries(texts.filter(lambda k: k not in ("label", *FIELDS)), texts, max_size=3),
)


@given(st.lists(rows, max_size=8))
def test_any_annotations_round_trip(tmp_path_factory, values):
    table = pl.DataFrame(
        [
            (
                t,
                min(a, b),
                max(a, b),
                label,
                json.dumps(m, sort_keys=True, ensure_ascii=False, separators=(",", ":")),
            )
            for t, a, b, label, m in values
        ],
        schema=TABLE.schema,
        orient="row",
    )
    path = tmp_path_factory.mktemp("n") / "a.mcap"
    with mr.create(path) as out:
        out.add_annotations(table)
    got = mr.open(path).annotations
    assert sorted(got.select(table.columns).rows()) == sorted(table.rows())
    assert got["start_ns"].is_sorted()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"end_ns": pl.lit(0, pl.Int64)}, "no interval"),
        ({"start_ns": pl.lit(-1, pl.Int64)}, "no interval"),
        ({"tier": pl.lit("")}, "tier ''"),
        ({"tier": pl.lit("/t")}, "tier '/t'"),
        ({"label": pl.lit(None, pl.String)}, "'label' has nulls"),
        ({"start_ns": pl.lit(1.5)}, "'start_ns': type Float64"),
        ({"metadata": pl.lit("[1]")}, "not an object"),
        ({"metadata": pl.lit("{")}, "not the text of a JSON object"),
        ({"metadata": pl.Series(['{},{"a":"}', '{"}', "{}"])}, "not the text of a JSON object"),
        ({"metadata": pl.lit('{"label": "x"}')}, "may not have the key 'label'"),
        ({"extra": pl.lit(1)}, "missing or unknown: extra"),
        ({"label": pl.lit("a\0b")}, "NUL"),
    ],
)
def test_a_wrong_annotation_is_refused(tmp_path, change, says):
    with pytest.raises(mr.MarchaError) as error, mr.create(tmp_path / "a.mcap") as out:
        out.add_annotations(TABLE.with_columns(**change))
    assert says in str(error.value)
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------------------------------- copies


@pytest.fixture
def source(tmp_path):
    with mr.create(tmp_path / "source.mcap") as out:
        out.add_table("/imu", IMU, imu(7000), "imu1", {"rate": "100"})
        out.add_table(
            "/step", "marcha_msgs/msg/Step", sample_table("marcha_msgs/msg/Step", 9, start_ns=10**10)
        )
        out.add_annotations(TABLE)
        out.add_metadata("walk", {"closed": "true"})
        out.add_attachment("a.txt", b"abc", "text/plain")
    return mr.open(tmp_path / "source.mcap")


def chunk_bytes(path) -> list[bytes]:
    rec = mr.open(path)
    return [rec.file.read(c.start, c.length) for c in rec.contents.chunks]


def test_a_copy_has_everything_and_the_same_chunks(source, tmp_path):
    with mr.create(tmp_path / "copy.mcap") as out:
        out.copy_from(source)
    copy = mr.open(tmp_path / "copy.mcap")
    assert copy.channels == source.channels
    for topic in source.channels:
        assert copy.table(topic, log_time=True).equals(source.table(topic, log_time=True))
    assert copy.metadata == source.metadata
    assert copy.attachment("a.txt") == b"abc"
    assert copy.annotations.equals(source.annotations)
    assert chunk_bytes(copy.path)[:4] == chunk_bytes(source.path)[:4]
    assert structure(copy) == []


def test_results_stand_beside_the_copied_channels(source, tmp_path):
    with mr.create(tmp_path / "copy.mcap") as out:
        out.add_table(
            "/estimate/a/stance", "marcha_msgs/msg/Stance", sample_table("marcha_msgs/msg/Stance", 5)
        )
        out.copy_from(source, ["/imu", "/annotation/gait"])
        out.add_annotations(TABLE.filter(pl.col("tier") == "terrain")[:1])
    copy = mr.open(tmp_path / "copy.mcap")
    assert sorted(copy.channels) == ["/annotation/gait", "/annotation/terrain", "/estimate/a/stance", "/imu"]
    assert copy.table("/imu").equals(source.table("/imu"))
    assert copy.channels["/imu"].metadata == {"rate": "100"}
    assert copy.annotations["label"].to_list() == ["Stürzt", "stairs"]
    assert structure(copy) == []


def test_two_recordings_become_one(source, tmp_path):
    other = mr.open(write(tmp_path / "b.mcap", {"/other": (IMU, imu(4000, 3))}))
    with mr.create(tmp_path / "both.mcap") as out:
        out.copy_from(source)
        out.copy_from(other)
    both = mr.open(tmp_path / "both.mcap")
    assert both.table("/other").equals(other.table("/other"))
    assert both.table("/imu").equals(source.table("/imu"))
    assert structure(both) == []


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda out, rec: [out.copy_from(rec), out.copy_from(rec)], "in both recordings"),
        (lambda out, rec: out.copy_from(rec, ["/no"]), "no topic /no; there are: /imu"),
        (lambda out, rec: [out.copy_from(rec), out.add_table("/imu", IMU, imu(3))], "there already"),
    ],
)
def test_a_wrong_copy_is_refused(source, tmp_path, call, says):
    with pytest.raises(mr.UsageError) as error, mr.create(tmp_path / "x.mcap") as out:
        call(out, source)
    assert says in str(error.value)
    assert not (tmp_path / "x.mcap").exists()


def test_a_damaged_recording_is_copied_as_far_as_it_is_sound(source, tmp_path):
    (tmp_path / "cut.mcap").write_bytes(source.path.read_bytes()[:400_000])
    with mr.create(tmp_path / "copy.mcap") as out:
        out.copy_from(mr.open(tmp_path / "cut.mcap"))
    copy = mr.open(tmp_path / "copy.mcap")
    got = copy.table("/imu")
    assert 0 < got.height < 7000
    assert got.equals(source.table("/imu")[: got.height])
    assert (copy.findings, structure(copy)) == ([], [])


def test_provenance_names_and_hashes_the_sources(tmp_path):
    (tmp_path / "raw.txt").write_bytes(b"abc")
    golden = (  # RFC 7693, appendix A: BLAKE2b-512("abc")
        "ba80a53f981c4d0d6a2797b69f12f6e94c212f14685ac4b74b12bb6fdbffa2d1"
        "7d87c5392aab792dc252d5de4533cc9518d38aa8dbf1925ab92386edd4009923"
    )
    assert hash_file(tmp_path / "raw.txt") == golden
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_metadata("provenance", provenance([tmp_path / "raw.txt"], importer="table", options={"a": 1}))
    record = mr.open(tmp_path / "a.mcap").metadata
    assert [(s.name, s.size, s.blake2b) for s in sources_of(record)] == [("raw.txt", 3, golden)]
    assert record["provenance"]["options"] == '{"a": 1}'
    with pytest.raises(mr.MarchaError, match="none"):
        hash_file(tmp_path / "none")
