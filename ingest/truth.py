"""The truth of a simulated walk, in side files beside the raw log.

``<stem>.truth.csv`` has ``t_ns`` on the device's unrolled clock, pose and velocity of sensor 1 and whether
the foot is still; it becomes ``/reference/pose``, ``/reference/velocity`` and ``/reference/stance``.
``<stem>.truth.imu2.csv`` has the same of sensor 2, for ``/reference/imu2/pose`` and so on.
``<stem>.truth.leg.csv`` has ``t_ns``, columns ``joint.<name>`` (rad) and ``<segment>.quat_w`` …, for
``/reference/joint`` and ``/reference/<segment>/orientation``.
``<stem>.truth.fix.csv`` has ``t_ns``, latitude, longitude (deg) and height of the same walk, for ``/reference/fix``.
``<stem>.truth.steps.csv`` has the steps of a person with a phone, for ``/reference/steps``; stance is left out.
``<stem>.truth.marks.csv`` has annotations: ``tier,start_ns,end_ns,label``.
``<stem>.truth.toml`` holds facts (closed, length_m, scenario, seed …) for the metadata record ``truth``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import polars as pl

from ..recording.errors import MarchaError, UsageError
from ..recording.files import read_toml
from .contract import ChannelSpec

POSE = ("pos_x", "pos_y", "pos_z", "quat_w", "quat_x", "quat_y", "quat_z")
FIX = ("lat_deg", "lon_deg", "alt_m")
STEP = "marcha_msgs/msg/Step"
VELOCITY = ("vel_x", "vel_y", "vel_z")

SCHEMAS = (
    ("pose", "geometry_msgs/msg/PoseStamped", POSE),
    ("velocity", "geometry_msgs/msg/Vector3Stamped", VELOCITY),
    ("stance", "marcha_msgs/msg/Stance", ("still",)),
)


WALK_FACTS = ("closed", "length_m")
"""Facts of a walk that ``convert --set`` takes as well: as truth, whatever the format."""


def walk_facts(stated: Mapping[str, Any]) -> dict[str, str]:
    """Return what a user knows of a walk, as text.

    Parameters
    ----------
    stated : mapping
        ``closed`` (true or false), ``length_m`` (m), ``steps`` and other facts by name.

    Raises
    ------
    UsageError
        ``closed`` is neither true nor false, or ``length_m`` or ``steps`` is no positive number.
    """
    facts = {name: as_text(value).strip() for name, value in stated.items()}
    for name, text in facts.items():
        if name == "closed":
            facts[name] = text.lower()
            if text.lower() not in ("true", "false"):
                raise UsageError(f"truth closed={text!r}: is neither true nor false")
        elif name in ("length_m", "steps"):
            try:
                good = 0 < float(text) < math.inf
            except ValueError:
                good = False
            if not good:
                raise UsageError(f"truth {name}={text!r}: is no positive number")
    return facts


class TruthFile(msgspec.Struct, frozen=True):
    """Truth known about a walk.

    Attributes
    ----------
    files : tuple of Path
        Where it was read.
    metadata : dict of str to str
        ``closed``, ``length_m``, ``scenario``, ``seed`` …
    tables : dict of ChannelSpec to polars.DataFrame
        The reference channels.
    annotations : polars.DataFrame or None
        Tiers with their labels.
    """

    files: tuple[Path, ...]
    metadata: dict[str, str]
    tables: list[tuple[ChannelSpec, pl.DataFrame]]
    annotations: pl.DataFrame | None = None


def is_side_file(path: Path) -> bool:
    """Whether a file is the truth of another one, not a recording."""
    return bool(re.search(r"\.truth(\.\w+)?\.(csv|toml)$", path.name))


def read_truth(path: Path) -> TruthFile | None:
    """Read the truth beside a raw log; None where there is none.

    Raises
    ------
    MarchaError
        A side file is damaged.
    """
    facts_file = path.with_name(f"{path.stem}.truth.toml")
    parts = {"": f"{path.stem}.truth.csv", "imu2/": f"{path.stem}.truth.imu2.csv"}
    facts = _facts(facts_file) if facts_file.is_file() and path.suffix != ".trc" else {}
    frame = "plan" if facts.get("frame") == "plan" else "nav"
    tables = []
    files = []
    if (steps := path.with_name(f"{path.stem}.truth.steps.csv")).is_file():
        files.append(steps)
        walked = _steps(steps)  # without a row where nobody walks: the columns are said beforehand
        tables.append((ChannelSpec("/reference/steps", STEP, frame, tuple(walked.columns[1:])), walked))
    if (places := path.with_name(f"{path.stem}.truth.fix.csv")).is_file():
        files.append(places)
        spec = ChannelSpec("/reference/fix", "sensor_msgs/msg/NavSatFix", "wgs84", FIX)
        tables.append((spec, _numbers(places, FIX)))
    for part, name in parts.items():
        if (file := path.with_name(name)).is_file():
            files.append(file)
            table = _table(file)
            tables += [
                (ChannelSpec(f"/reference/{part}{what}", schema, frame), table.select("t_ns", *columns))
                for what, schema, columns in SCHEMAS
                if what != "stance" or not steps.is_file()
            ]
    if (file := path.with_name(f"{path.stem}.truth.leg.csv")).is_file() and path.suffix != ".trc":
        files.append(file)
        tables += _leg(file)
    marks = None
    if (file := path.with_name(f"{path.stem}.truth.marks.csv")).is_file():
        files.append(file)
        marks = _marks(file)
    if facts:  # a capture's truth comes with its inertial log
        files.append(facts_file)
    if not files:
        return None
    return TruthFile(tuple(files), facts, tables, marks)


def _leg(file: Path) -> Iterator[tuple[ChannelSpec, pl.DataFrame]]:
    try:
        table = pl.read_csv(file, infer_schema_length=None)
        joints = [c for c in table.columns if c.startswith("joint.")]
        angles = table.select(
            pl.col("t_ns").cast(pl.Int64), *(pl.col(c).alias(c[6:]).cast(pl.Float64) for c in joints)
        )
        channels = [
            (
                ChannelSpec("/reference/joint", "sensor_msgs/msg/JointState", "", tuple(angles.columns[1:])),
                angles,
            )
        ]
        for name in dict.fromkeys(c.partition(".quat_")[0] for c in table.columns if ".quat_" in c):
            turned = table.select("t_ns", *(pl.col(f"{name}.quat_{a}").alias(f"quat_{a}") for a in "wxyz"))
            spec = ChannelSpec(f"/reference/{name}/orientation", "geometry_msgs/msg/QuaternionStamped", "nav")
            channels.append((spec, turned))
    except (OSError, pl.exceptions.PolarsError) as error:
        raise MarchaError(f"{file}: not a readable truth table: {str(error).splitlines()[0]}") from error
    yield from channels


def as_text(value: object) -> str:
    """Return a fact as metadata text: ``true``/``false``, numbers in full."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def _facts(file: Path) -> dict[str, str]:
    facts = read_toml(file)
    if not isinstance(facts, dict):
        raise MarchaError(f"{file}: holds no table of facts; repair or remove it")
    return dict(_flat("", facts))


def _flat(prefix: str, facts: dict[str, object]) -> Iterator[tuple[str, str]]:
    for key, value in facts.items():
        if isinstance(value, dict):
            yield from _flat(f"{prefix}{key}.", value)
        else:
            yield f"{prefix}{key}", as_text(value)


def _steps(file: Path) -> pl.DataFrame:
    """Return the steps, each at the contact that ends it."""
    whole = {"start_ns": pl.Int64, "end_ns": pl.Int64, "index": pl.UInt32}
    columns = whole | dict.fromkeys(("length_m", "height_m", "heading_rad"), pl.Float64)
    try:
        table = pl.read_csv(file, schema_overrides=columns).select(pl.col("end_ns").alias("t_ns"), *columns)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise MarchaError(f"{file}: not a readable table of steps: {str(error).splitlines()[0]}") from error
    if table.null_count().sum_horizontal().item() or not table["t_ns"].is_sorted():
        raise MarchaError(f"{file}: a table of steps has no empty cells and its time never decreases")
    return table


def _marks(file: Path) -> pl.DataFrame:
    columns = {"tier": pl.String, "start_ns": pl.Int64, "end_ns": pl.Int64, "label": pl.String}
    try:
        table = pl.read_csv(file, schema_overrides=columns).select(*columns)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise MarchaError(f"{file}: not a readable table of labels: {str(error).splitlines()[0]}") from error
    if table.null_count().sum_horizontal().item() or (table["end_ns"] < table["start_ns"]).any():
        raise MarchaError(f"{file}: a table of labels has no empty cells, and none ends before it starts")
    return table


def _table(file: Path) -> pl.DataFrame:
    table = _numbers(file, (*POSE, *VELOCITY), still=pl.String)
    return table.with_columns(pl.col("still").is_in(["1", "true", "True", "1.0"]))


def _numbers(file: Path, names: Sequence[str], **others: type[pl.DataType]) -> pl.DataFrame:
    """Return a table of truth: ``t_ns``, numbers, and other columns."""
    columns = {"t_ns": pl.Int64, **dict.fromkeys(names, pl.Float64), **others}
    try:
        table = pl.read_csv(file, schema_overrides=columns)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise MarchaError(f"{file}: not a readable truth table: {str(error).splitlines()[0]}") from error
    missing = [c for c in columns if c not in table.columns]
    if missing:
        raise MarchaError(f"{file}: column {missing[0]} is missing; a truth table has {', '.join(columns)}")
    table = table.select(*columns)
    if table.null_count().sum_horizontal().item() or not table["t_ns"].is_sorted():
        raise MarchaError(f"{file}: a truth table has no empty cells and its time never decreases")
    return table
