"""Byte layout: equal to rosbags for our types, and for types and values made up at random."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.recording import SCHEMAS
from marcha.recording.cdr import CdrError, decode, encode, layout_of_message
from marcha.recording.definitions import PRIMITIVES, Definition, Field, full_text, load, long_name, parse_full
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from .recording_samples import sample_table, write


def store_for(*names: str):
    """Return a rosbags type store that knows our own types too."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name in names:
        types = get_types_from_msg(full_text(name), long_name(name))
        store.register({k: v for k, v in types.items() if k not in store.fielddefs})
    return store


@pytest.mark.parametrize("schema", sorted(SCHEMAS))
def test_bytes_equal_those_of_rosbags(schema, tmp_path):
    path = write(tmp_path / "a.mcap", {"/x": (schema, sample_table(schema, 20))})
    store = store_for(schema)
    with path.open("rb") as file:
        raws = [m.data for _, _, m in make_reader(file, validate_crcs=True).iter_messages()]
    assert len(raws) == 20
    for raw in raws:
        assert bytes(store.serialize_cdr(store.deserialize_cdr(raw, schema), schema)) == raw


@pytest.mark.parametrize("frame_id", ["", "a", "ab", "abc", "abcd", "abcde", "imu_link", "é"])
def test_padding_behind_every_length_of_frame_id(frame_id):
    library = load("sensor_msgs/msg/Imu")
    definition = library["sensor_msgs/Imu"]
    vector = {"x": 1.0, "y": 2.0, "z": 3.0}
    value = {
        "header": {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": frame_id},
        "orientation": {**vector, "w": 4.0},
        "orientation_covariance": [-1.0] * 9,
        "angular_velocity": vector,
        "angular_velocity_covariance": [0.5] * 9,
        "linear_acceleration": vector,
        "linear_acceleration_covariance": [0.25] * 9,
    }
    raw = encode(value, definition, library)
    store = store_for()
    theirs: Any = store.deserialize_cdr(raw, "sensor_msgs/msg/Imu")
    assert theirs.header.frame_id == frame_id
    assert bytes(store.serialize_cdr(theirs, "sensor_msgs/msg/Imu")) == raw
    assert decode(raw, definition, library) == value


# ---------------------------------------------------------------------------------------- made up at random

NUMBERS = [p for p in PRIMITIVES if p not in ("char", "byte")]


@st.composite
def libraries(draw) -> dict[str, Definition]:
    """Up to three message types, each using those after it."""
    count = draw(st.integers(1, 3))
    out: list[Definition] = []
    for i in reversed(range(count)):
        fields = []
        for k in range(draw(st.integers(1, 5))):
            kinds = [*NUMBERS, "string", *(d.name for d in out)]
            fields.append(
                Field(f"f{k}", draw(st.sampled_from(kinds)), draw(st.sampled_from([None, None, -1, 2])))
            )
        out.append(Definition(f"pkg/M{i}", tuple(fields), {}))
    return {d.name: d for d in reversed(out)}


def value_of(draw, type_: str, library):
    if type_ == "string":
        return draw(
            st.text(st.characters(blacklist_characters="\0", blacklist_categories=["Cs"]), max_size=9)
        )
    if type_ in library:
        return message_of(draw, library[type_], library)
    kind = np.dtype(PRIMITIVES[type_])
    if kind.kind == "b":
        return draw(st.booleans())
    if kind.kind == "f":
        return draw(st.floats(width=8 * kind.itemsize))  # pyright: ignore[reportArgumentType]
    info = np.iinfo(kind)
    return draw(st.integers(int(info.min), int(info.max)))


def message_of(draw, definition: Definition, library):
    out = {}
    for field in definition.fields:
        if field.length is None:
            out[field.name] = value_of(draw, field.type, library)
        else:
            count = draw(st.integers(0, 3)) if field.length == -1 else field.length
            out[field.name] = [value_of(draw, field.type, library) for _ in range(count)]
    return out


def text_of(library) -> str:
    def body(definition: Definition) -> str:
        mark = {None: "", -1: "[]"}
        return "".join(f"{f.type}{mark.get(f.length, f'[{f.length}]')} {f.name}\n" for f in definition.fields)

    first, *rest = library.values()
    return body(first) + "".join(f"{'=' * 80}\nMSG: {d.name}\n{body(d)}" for d in rest)


def same(a, b) -> bool:
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, float) and math.isnan(a):
        return isinstance(b, float) and math.isnan(b)
    return a == b


@given(st.data())
def test_any_message_round_trips_and_equals_rosbags(data):
    library = data.draw(libraries())
    top = next(iter(library.values()))
    value = message_of(data.draw, top, library)
    raw = encode(value, top, library)
    assert same(decode(raw, top, library), value)
    assert parse_full(top.name, text_of(library)) == {k: library[k] for k in library}
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text_of(library), long_name(top.name)))
    theirs = store.deserialize_cdr(raw, long_name(top.name))
    assert bytes(store.serialize_cdr(theirs, long_name(top.name))) == raw
    big = bytes(store.serialize_cdr(theirs, long_name(top.name), little_endian=False))
    assert same(decode(big, top, library), value)


@given(st.data(), st.binary(max_size=40))
def test_bytes_that_are_no_message_raise_only_cdr_error(data, noise):
    library = data.draw(libraries())
    top = next(iter(library.values()))
    raw = b"\x00\x01\x00\x00" + noise
    try:
        layout = layout_of_message(raw, top, library)
    except CdrError:
        return
    assert layout.dtype.itemsize <= len(raw)


@pytest.mark.parametrize(
    ("raw", "says"),
    [(b"", "0 bytes"), (b"\x00\x03\x00\x00\0\0\0\0", "encapsulation"), (b"\0\1\0\0\1", "5 bytes")],
)
def test_what_is_wrong_with_a_message_is_said(raw, says):
    library = load("builtin_interfaces/Time")
    with pytest.raises(CdrError, match=says):
        decode(raw, library["builtin_interfaces/Time"], library)


def test_a_missing_or_unknown_field_is_refused():
    library = load("builtin_interfaces/Time")
    with pytest.raises(CdrError, match="nanosec, nsec"):
        encode({"sec": 1, "nsec": 2}, library["builtin_interfaces/Time"], library)


def test_a_number_out_of_range_is_refused():
    library = load("builtin_interfaces/Time")
    with pytest.raises(CdrError, match="sec"):
        encode({"sec": 2**31, "nanosec": 2}, library["builtin_interfaces/Time"], library)
