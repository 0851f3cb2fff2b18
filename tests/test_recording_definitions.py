"""Our .msg texts against an independent parser, and what the parser refuses."""

from __future__ import annotations

import pytest
from marcha.recording import SCHEMAS, MarchaError
from marcha.recording.definitions import full_text, known_types, load, long_name, parse, parse_full
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

JAZZY = get_typestore(Stores.ROS2_JAZZY)


@pytest.mark.parametrize("name", sorted(n for n in known_types() if long_name(n) in JAZZY.fielddefs))
def test_equals_the_jazzy_definition(name):
    ours = get_types_from_msg(full_text(name), long_name(name))[long_name(name)]
    constants, fields = JAZZY.fielddefs[long_name(name)]
    assert list(ours[1]) == fields
    assert sorted(ours[0]) == sorted(constants)


@pytest.mark.parametrize("name", sorted(known_types()))
def test_own_parser_reads_the_same_fields_as_rosbags(name):
    theirs = get_types_from_msg(full_text(name), long_name(name))[long_name(name)]
    ours = parse_full(name, full_text(name))[name]
    assert [f.name for f in ours.fields] == [n for n, _ in theirs[1]]
    assert set(ours.constants) == {n for n, *_ in theirs[0]}


@pytest.mark.parametrize("name", sorted(known_types()))
def test_schema_record_text_gives_back_the_library(name):
    assert parse_full(name, full_text(name)) == load(name)


@pytest.mark.parametrize("schema", sorted(SCHEMAS))
def test_every_column_has_a_field(schema):
    spec = SCHEMAS[schema]
    library = load(schema)
    for column in spec.columns:
        definition = next(iter(library.values()))
        path = f"{spec.explode}[0].{column.field}" if spec.explode else column.field
        for part in path.split("."):
            field = {f.name: f for f in definition.fields}[part.split("[")[0]]
            definition = library.get(field.type, definition)


def test_bounds_defaults_constants_and_comments():
    text = "# head\nuint8 A=1 # one\nstring<=5 name 'x # y'\nfloat32[<=3] few\n"
    text += "int16[2] pair [1, 2]\nHeader header\n"
    definition = parse("pkg/msg/Odd", text)
    assert [(f.name, f.type, f.length) for f in definition.fields] == [
        ("name", "string", None),
        ("few", "float32", -1),
        ("pair", "int16", 2),
        ("header", "std_msgs/Header", None),
    ]
    assert definition.constants == {"A": "1"}


def test_empty_message_has_the_byte_that_rosidl_gives_it():
    assert [f.type for f in parse("pkg/Empty", "# nothing\n").fields] == ["uint8"]


def test_a_line_that_is_nothing_is_named():
    with pytest.raises(MarchaError, match=r"pkg/Bad\.msg line 2: .*'\?\?\?'"):
        parse("pkg/Bad", "int8 a\n???\n")


def test_unknown_dependency_is_named():
    with pytest.raises(MarchaError, match="other/Thing"):
        parse_full("pkg/A", "other/Thing x\n")


@pytest.mark.parametrize("name", ["a\0b/Thing", "../Thing", "a/", "é/Thing"])
def test_a_name_that_is_none_never_becomes_a_path(name: str) -> None:
    with pytest.raises(MarchaError, match="a name is package/Type"):
        load(name)
