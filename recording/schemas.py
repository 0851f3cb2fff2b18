"""Columns of every message type: names, units, frames, and the message field behind each.

This is the one table that the codec, ``marcha info`` and ``docs/recording-format.md`` read.
"""

from __future__ import annotations

import msgspec

from .errors import UsageError


class Column(msgspec.Struct, frozen=True):
    """One column of a channel's table.

    Attributes
    ----------
    name : str
        Column name. In a named schema it is the suffix behind the joint's or value's name.
    unit : str
        Unit, ``-`` for none, ``as named`` where the name says it.
    field : str
        Path of the message field; ``[i]`` stands for the place of the name in a named schema.
    doc : str
        What it is and in which frame.
    kind : str
        ``number`` (Float64 or the field's integer type), ``time`` (Int64 nanoseconds from sec and nanosec),
        ``sigma`` (standard deviation, variance in the message), ``flag`` (Boolean), ``mac`` (text
        ``aa:bb:cc:dd:ee:ff``), ``technology`` (text, one of :data:`TECHNOLOGIES`), ``text``.
    """

    name: str
    unit: str
    field: str
    doc: str
    kind: str = "number"


class ColumnGroup(msgspec.Struct, frozen=True):
    """Columns that are there together or not at all.

    Attributes
    ----------
    columns : tuple of Column
        The columns.
    optional : bool
        Whether a channel may lack them.
    absent : dict of str to float
        What the message fields hold where the group is absent.
    present : dict of str to float
        Fields to set where it is there.
    mark : tuple of (str, float) or None
        Field and value by which a message says that the group is absent (REP-145: covariance[0] = -1).
    """

    columns: tuple[Column, ...]
    optional: bool = False
    absent: dict[str, float] = {}
    present: dict[str, float] = {}
    mark: tuple[str, float] | None = None


class Schema(msgspec.Struct, frozen=True):
    """How a message type becomes a table.

    Attributes
    ----------
    name : str
        ``package/msg/Name``.
    title : str
        What the message is for.
    groups : tuple of ColumnGroup
        Columns; ``t_ns`` comes before them in every table.
    names : str
        In a named schema the field with the names (constant in a channel): every column exists once a name.
    explode : str
        Sequence whose elements become one row each (``tf2_msgs/msg/TFMessage``).
    stamp, frame : str
        Fields of the time that the message speaks of and of the frame id.
    """

    name: str
    title: str
    groups: tuple[ColumnGroup, ...]
    names: str = ""
    explode: str = ""
    stamp: str = "header.stamp"
    frame: str = "header.frame_id"

    @property
    def columns(self) -> tuple[Column, ...]:
        """All columns that a table may have, without ``t_ns`` (in a named schema: the suffixes)."""
        return tuple(c for g in self.groups for c in g.columns)

    @property
    def needed(self) -> tuple[str, ...]:
        """Columns that every table has; none in a named schema."""
        return () if self.names else tuple(c.name for g in self.groups if not g.optional for c in g.columns)


def declared_columns(schema: Schema, text: str) -> tuple[str, ...] | None:
    """Return the columns that a channel's metadata declare; None where they are not those of its messages."""
    try:
        names = msgspec.json.decode(text, type=tuple[str, ...])
    except (msgspec.MsgspecError, RecursionError):  # anybody may write this key
        return None
    if schema.names:
        fits = all(any(n.endswith(c.name) for c in schema.columns) for n in names)
    else:
        groups = [{c.name for c in g.columns} for g in schema.groups]
        whole = all(g <= set(names) or not g & set(names) for g in groups)
        fits = whole and set(schema.needed) <= set(names) <= set().union(*groups)
    return names if fits and len(set(names)) == len(names) and "t_ns" not in names else None


TECHNOLOGIES = ("unknown", "wifi", "ble", "uwb", "cell", "zigbee")
"""Names of ``TECHNOLOGY_*`` in ``marcha_msgs/msg/RadioSignal``, by value."""

_NAN = float("nan")


def _xyz(prefix: str, unit: str, field: str, doc: str) -> tuple[Column, ...]:
    return tuple(Column(f"{prefix}_{a}", unit, f"{field}.{a}", f"{doc}, {a}") for a in "xyz")


def _quat(field: str, doc: str) -> tuple[Column, ...]:
    return tuple(
        Column(f"quat_{a}", "-", f"{field}.{a}", f"{doc}, {'real part' if a == 'w' else a}") for a in "wxyz"
    )


_IDENTITY = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


def _nan(*columns: Column) -> dict[str, float]:
    return {c.field: _NAN for c in columns}


def _imu_group(columns: tuple[Column, ...], covariance: str) -> ColumnGroup:
    absent = {**_nan(*columns), f"{covariance}[0]": -1.0}
    return ColumnGroup(columns, optional=True, absent=absent, mark=(f"{covariance}[0]", -1.0))


def _pose(position: str, rotation: str, doc: str) -> tuple[ColumnGroup, ColumnGroup]:
    identity = {f"{rotation}.{a}": v for a, v in _IDENTITY.items()}
    return (
        ColumnGroup(_xyz("pos", "m", position, f"position {doc}")),
        ColumnGroup(_quat(rotation, f"rotation {doc}"), optional=True, absent=identity),
    )


_MAC = Column("mac", "-", "mac", "hardware address of the transmitter, aa:bb:cc:dd:ee:ff", "mac")
_TECHNOLOGY = Column("technology", "-", "technology", "unknown, wifi, ble, uwb, cell or zigbee", "technology")
_IMU_QUAT = _quat("orientation", "rotation from the sensor frame to the navigation frame (rot_nb)")
_ACC = _xyz("acc", "m/s²", "linear_acceleration", "specific force in the sensor frame")
_GYR = _xyz("gyr", "rad/s", "angular_velocity", "angular rate in the sensor frame")
_IN_NAV = "of frame_id's or the body's origin in the navigation frame"
_NAVIGATION_SIGMAS = (
    ("pos", "m", "position", "standard deviation of the position in the navigation frame"),
    ("vel", "m/s", "velocity", "standard deviation of the velocity in the navigation frame"),
    ("att", "rad", "attitude", "standard deviation of the attitude, about the navigation frame's axes"),
)
_SD = tuple(
    Column(f"sd_{a}_m", "m", f"position_covariance[{4 * i}]", f"standard deviation, {a}", "sigma")
    for i, a in enumerate(("east", "north", "up"))
)

_ALL = (
    Schema(
        "sensor_msgs/msg/Imu",
        "accelerometer, gyroscope, orientation",
        (
            _imu_group(_ACC, "linear_acceleration_covariance"),
            _imu_group(_GYR, "angular_velocity_covariance"),
            _imu_group(_IMU_QUAT, "orientation_covariance"),
        ),
    ),
    Schema(
        "sensor_msgs/msg/MagneticField",
        "magnetometer",
        (ColumnGroup(_xyz("mag", "T", "magnetic_field", "magnetic field in the sensor frame")),),
    ),
    Schema(
        "sensor_msgs/msg/NavSatFix",
        "GNSS fix",
        (
            ColumnGroup(
                (
                    Column("lat_deg", "°", "latitude", "geodetic latitude, WGS 84, north positive"),
                    Column("lon_deg", "°", "longitude", "longitude, WGS 84, east positive"),
                )
            ),
            ColumnGroup(
                (
                    Column(
                        "alt_m",
                        "m",
                        "altitude",
                        "height above the WGS 84 ellipsoid (as the device states it)",
                    ),
                ),
                optional=True,
                absent={"altitude": _NAN},
            ),
            ColumnGroup(
                _SD,
                optional=True,
                present={"position_covariance_type": 2},
                mark=("position_covariance_type", 0),
            ),
            ColumnGroup(
                (
                    Column("status", "-", "status.status", "NavSatStatus: -1 no fix, 0 fix, 1 SBAS, 2 GBAS"),
                    Column(
                        "service",
                        "-",
                        "status.service",
                        "NavSatStatus: 1 GPS, 2 GLONASS, 4 BeiDou, 8 Galileo",
                    ),
                ),
                optional=True,  # a row of a table of fixes is a fix
            ),
        ),
    ),
    Schema(
        "sensor_msgs/msg/FluidPressure",
        "barometer",
        (ColumnGroup((Column("pressure_pa", "Pa", "fluid_pressure", "absolute pressure"),)),),
    ),
    Schema(
        "sensor_msgs/msg/Temperature",
        "temperature",
        (ColumnGroup((Column("temperature_c", "°C", "temperature", "temperature"),)),),
    ),
    Schema(
        "sensor_msgs/msg/JointState",
        "joint angles: encoder, reference or estimate",
        (
            ColumnGroup((Column("", "rad", "position[i]", "angle (or m of a prismatic joint)"),)),
            ColumnGroup((Column(".vel", "rad/s", "velocity[i]", "angular rate"),), optional=True),
            ColumnGroup((Column(".effort", "N m", "effort[i]", "torque"),), optional=True),
        ),
        names="name",
    ),
    Schema(
        "geometry_msgs/msg/PoseStamped",
        "pose, reference trajectory, reconstructed trajectory",
        _pose("pose.position", "pose.orientation", _IN_NAV),
    ),
    Schema(
        "geometry_msgs/msg/PointStamped",
        "position",
        (ColumnGroup(_xyz("pos", "m", "point", f"position {_IN_NAV}")),),
    ),
    Schema(
        "geometry_msgs/msg/QuaternionStamped",
        "orientation",
        (ColumnGroup(_quat("quaternion", "rotation from the body frame to the navigation frame (rot_nb)")),),
    ),
    Schema(
        "geometry_msgs/msg/Vector3Stamped",
        "velocity",
        (ColumnGroup(_xyz("vel", "m/s", "vector", "velocity in the navigation frame")),),
    ),
    Schema(
        "geometry_msgs/msg/TwistStamped",
        "velocity and angular rate",
        (
            ColumnGroup(_xyz("vel", "m/s", "twist.linear", "velocity in frame_id")),
            ColumnGroup(_xyz("gyr", "rad/s", "twist.angular", "angular rate in frame_id")),
        ),
    ),
    Schema(
        "geometry_msgs/msg/TransformStamped",
        "transform from the child frame to frame_id",
        (
            *_pose("transform.translation", "transform.rotation", "of the child frame in frame_id"),
            ColumnGroup((Column("child_frame_id", "-", "child_frame_id", "the child frame", "text"),)),
        ),
    ),
    Schema(
        "tf2_msgs/msg/TFMessage",
        "frames, static; one row a transform",
        (
            *_pose("transform.translation", "transform.rotation", "of the child frame in its parent"),
            ColumnGroup(
                (
                    Column("parent_frame_id", "-", "header.frame_id", "the parent frame", "text"),
                    Column("child_frame_id", "-", "child_frame_id", "the child frame", "text"),
                )
            ),
        ),
        explode="transforms",
        frame="",
    ),
    Schema(
        "marcha_msgs/msg/Stance",
        "whether the foot is still",
        (ColumnGroup((Column("still", "-", "still", "true while still", "flag"),)),),
    ),
    Schema(
        "marcha_msgs/msg/Step",
        "one step or stride",
        (
            ColumnGroup(
                (
                    Column("start_ns", "ns", "start", "start of the swing", "time"),
                    Column("end_ns", "ns", "end", "end of the swing", "time"),
                    Column("index", "-", "index", "number of the step, from 0"),
                    Column("length_m", "m", "length", "horizontal distance between the two stances"),
                    Column("height_m", "m", "height", "height gained, up positive"),
                    Column("heading_rad", "rad", "heading", "direction in the navigation frame, from x to y"),
                )
            ),
        ),
    ),
    Schema(
        "marcha_msgs/msg/NavigationSigma",
        "the standard deviations that an estimator states of its own position, velocity and attitude",
        tuple(
            ColumnGroup(columns, optional=True, absent=_nan(*columns))
            for columns in (_xyz(f"sigma_{key}", *rest) for key, *rest in _NAVIGATION_SIGMAS)
        ),
    ),
    Schema(
        "marcha_msgs/msg/NamedValues",
        "numbers with names: detector statistics, standard deviations, filter internals",
        (ColumnGroup((Column("", "as named", "values[i]", "the value"),)),),
        names="names",
    ),
    Schema(
        "marcha_msgs/msg/OpticalMarkers",
        "markers of an optical system",
        tuple(
            ColumnGroup(
                (Column(f".{a}", "m", f"positions[i].{a}", f"position in frame_id, {a}; NaN where not seen"),)
            )
            for a in "xyz"
        ),
        names="names",
    ),
    Schema(
        "marcha_msgs/msg/RadioSignal",
        "Wi-Fi or BLE signal strength",
        (
            ColumnGroup((_MAC, Column("rssi_dbm", "dBm", "rssi", "received signal strength"))),
            ColumnGroup((_TECHNOLOGY,), optional=True),
            ColumnGroup(
                (
                    Column(
                        "tx_power_dbm", "dBm", "tx_power", "power that the transmitter states (BLE: at 1 m)"
                    ),
                ),
                optional=True,
                absent={"tx_power": _NAN},
            ),
            ColumnGroup(
                (Column("frequency_hz", "Hz", "frequency", "carrier frequency"),),
                optional=True,
                absent={"frequency": _NAN},
            ),
            ColumnGroup(
                (
                    Column(
                        "last_seen_ns", "ns", "last_seen", "last heard, by the receiver's own clock", "time"
                    ),
                ),
                optional=True,
            ),
        ),
    ),
    Schema(
        "marcha_msgs/msg/Ranging",
        "measured distance to an anchor",
        (
            ColumnGroup((_MAC, Column("distance_m", "m", "distance", "measured distance"))),
            ColumnGroup((_TECHNOLOGY,), optional=True),
            ColumnGroup(
                (Column("sd_m", "m", "sigma", "its standard deviation"),),
                optional=True,
                absent={"sigma": _NAN},
            ),
        ),
    ),
)

SCHEMAS: dict[str, Schema] = {s.name: s for s in _ALL}
"""Every message type that marcha writes, by name."""


def find_schema(name: str) -> Schema:
    """Return the schema of a name.

    Raises
    ------
    UsageError
        marcha does not write this type.
    """
    try:
        return SCHEMAS[name]
    except KeyError:
        raise UsageError(f"unknown message type {name!r}; one of {', '.join(SCHEMAS)}") from None
