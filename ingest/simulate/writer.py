"""Simulated recordings as files: the device's serial text or packets, and the truth beside them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, Literal

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from ...recording.errors import UsageError
from .floor import FLOOR_SCENARIOS
from .gait import Motion
from .leg import SCENARIOS as LEGS
from .leg import leg
from .legfiles import files
from .phone_routes import PHONE_SCENARIOS
from .together import written_together
from .walks import Simulation, checked, make_options

CHATTER = (
    "Initializing I2C...",
    "Configuring MPU-01...",
    "MPU-01 ready",
    "Configuring MPU-02...",
    "MPU-02 ready",
)
"""What the firmware says at boot."""

PACKET = np.dtype(
    [
        ("start", "S1"),
        ("id", "u1"),
        ("t_ms", ">u4"),
        ("q", ">i2", 4),
        ("a", ">i2", 3),
        ("g", ">i2", 3),
        ("end", "S2"),
    ]
)
"""One binary packet of one sensor, 28 bytes."""
PACKET_Q = 16384
"""Counts of a quaternion component of 1."""

TRUTH_COLUMNS = (
    ("pos", "pos_x pos_y pos_z"),
    ("quat_wxyz", "quat_w quat_x quat_y quat_z"),
    ("vel", "vel_x vel_y vel_z"),
)


class Line(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the serial terminal does to the text.

    Attributes
    ----------
    boot_chatter : bool
        The firmware's messages stand before the first row.
    cut_first, cut_last : bool
        The capture starts, ends in the middle of a row.
    wall_clock : bool
        The terminal prefixes every row with the time of day (``12:34:56.789 ``).
    """

    boot_chatter: bool = False
    cut_first: bool = False
    cut_last: bool = False
    wall_clock: bool = False


class Simulated(msgspec.Struct, frozen=True):
    """What :func:`simulate` wrote.

    Attributes
    ----------
    paths : list of Path
        The raw log: what ``convert`` takes.
    truth : list of Path
        Truth side files: the pose of sensor 1, that of sensor 2, the facts (TOML).
    rows : int
        Rows (sample times) in the log, doubled ones included.
    closed : bool
        Whether the walk ends where it began.
    length_m : float
        Horizontal length from footfall to footfall (m).
    """

    paths: list[Path]
    truth: list[Path]
    rows: int
    closed: bool
    length_m: float


def simulate(
    scenario: str,
    out_dir: Path | str,
    *,
    seed: int = 0,
    name: str | None = None,
    format: Literal["text", "packets", "android-text", "phyphox", "sensor-logger", "three-tables"] = "text",
    overwrite: bool = False,
    **options: Any,
) -> Simulated:
    """Write the raw log of a simulated walk and its truth.

    Files: ``conf-<config>-<name>.csv`` (or ``.bin``), ``….truth.csv`` (pose of sensor 1: ``t_ns`` of the
    device clock without roll-over, ``pos_*`` m, ``quat_*`` rot_nb, ``vel_*`` m/s, ``still``),
    ``….truth.imu2.csv`` (the same of sensor 2) and ``….truth.toml`` (closed, length_m, scenario, seed,
    every parameter, the biases that were drawn).

    Parameters
    ----------
    scenario : str
        A key of :data:`SCENARIOS`, of :data:`PHONE_SCENARIOS` or of :data:`FLOOR_SCENARIOS`.
    out_dir : Path or str
        Folder of the files; made where it is missing.
    seed : int
        Of all random numbers.
    name : str, optional
        Middle of the file names; default ``<scenario>-<seed>``.
    format : str
        ``text`` or ``packets``; of a phone ``android-text`` (or ``text``), ``phyphox`` or ``sensor-logger``; of a
        floor ``three-tables`` (or ``text``).
    overwrite : bool
        Replace files that are there.
    **options
        Fields of :class:`Options` and of :class:`Line`; of a phone those of :class:`PhoneOptions`.

    Returns
    -------
    Simulated
        Paths and facts.

    Raises
    ------
    UsageError
        Unknown scenario, format or option, or a value that breaks its rule.
    OutputExists
        A file is there already.
    """
    if scenario in LEGS:
        return _leg(scenario, Path(out_dir), seed, name, format, overwrite, options)
    if scenario in FLOOR_SCENARIOS:
        from .floor_files import write_floor

        if format not in ("text", "three-tables"):
            raise UsageError(
                f"simulate {scenario}: floors are written as three-tables; leave out format={format}"
            )
        paths, truth, on_floor = write_floor(
            scenario, Path(out_dir), seed=seed, name=name, overwrite=overwrite, options=options
        )
        phone = on_floor.phone
        return Simulated(paths, truth, len(phone.t_ns), phone.closed, phone.length_m)
    if scenario in PHONE_SCENARIOS:
        from .phone_files import write_phone

        kind = "android-text" if format == "text" else format
        paths, truth, walked = write_phone(
            scenario, Path(out_dir), seed=seed, name=name, format=kind, overwrite=overwrite, options=options
        )
        return Simulated(paths, truth, len(walked.t_ns), walked.closed, walked.length_m)
    if format not in ("text", "packets"):
        raise UsageError(f"simulate: format {format!r} is unknown: choose text or packets")
    line_given = {k: options.pop(k) for k in Line.__struct_fields__ if k in options}
    line = checked(scenario, Line, line_given)
    if format == "packets" and line != Line():
        raise UsageError(f"simulate {scenario}: only text has {', '.join(line_given)}; leave them out")
    simulation = Simulation(scenario, seed, make_options(scenario, options))
    stem = f"conf-{simulation.options.config}-{name or f'{scenario}-{seed:03d}'}"
    folder = Path(out_dir)
    log = folder / (stem + (".csv" if format == "text" else ".bin"))
    truths = [folder / f"{stem}.truth{part}" for part in (".csv", ".imu2.csv", ".toml")]
    with written_together(folder, (log, *truths), overwrite=overwrite) as part, ExitStack() as stack:
        raw, truth1, truth2, facts = (stack.enter_context((part / p.name).open("wb")) for p in (log, *truths))
        rows = _write(simulation, line, format, raw, (truth1, truth2))
        facts.write(msgspec.toml.encode(_facts(simulation, line, format)))
    return Simulated([log], truths, rows, simulation.route.closed, simulation.length_m)


def _leg(
    scenario: str,
    folder: Path,
    seed: int,
    name: str | None,
    format: str,
    overwrite: bool,
    options: dict[str, Any],
) -> Simulated:
    """Write a capture of legs: the exoskeleton's CSV with its mapping, the cameras' TRC, the truth."""
    if format != "text":
        raise UsageError(f"simulate {scenario}: captures of legs are text; leave out format={format}")
    capture = leg(scenario, seed=seed, **options)
    raw, truth = files(capture, folder, name or f"{scenario}-{seed:03d}")
    with written_together(folder, (*raw, *truth), overwrite=overwrite) as part:
        for path, content in (*raw.items(), *truth.items()):
            (part / path.name).write_bytes(content)
    logs = [p for p in raw if p.suffix != ".toml"]  # the mapping is found beside the CSV
    return Simulated(logs, [*truth, *(p for p in raw if p.suffix == ".toml")], len(capture.t), False, 0.0)


def _write(
    simulation: Simulation, line: Line, format: str, raw: IO[bytes], truths: tuple[IO[bytes], IO[bytes]]
) -> int:
    """Write the log and both truths, block by block; return the number of rows of the log."""
    options, rng = simulation.options, simulation.line_rng()
    imus = [simulation.imu(1), simulation.imu(2)]
    rows = 0
    text = _Text(line, options.start_ms)
    for number, t in enumerate(simulation.times()):
        motions = [simulation.motion(t, sensor) for sensor in (1, 2)]
        t_ns = simulation.clock_ns(t)
        for motion, truth in zip(motions, truths, strict=True):
            truth_table(t_ns, motion).write_csv(truth, include_header=number == 0)
        counts = [imu.counts(imu.read(m.acc_b, m.gyr_b)) for imu, m in zip(imus, motions, strict=True)]
        copies = (rng.random(len(t)) >= options.drop_share).astype(np.int64)
        copies += copies * (rng.random(len(t)) < options.duplicate_share)
        stamp = np.repeat(t_ns // 1_000_000, copies)
        counts = [np.repeat(c, copies, axis=0) for c in counts]
        rows += len(stamp)
        if format == "text":
            text.write(raw, stamp, np.hstack(counts))
        else:
            quats = [np.repeat(m.quat_wxyz, copies, axis=0) for m in motions]
            raw.write(_packets(stamp, quats, counts).tobytes())
    if format == "text":
        text.finish(raw)
    return rows


def truth_table(t_ns: NDArray[np.int64], motion: Motion) -> pl.DataFrame:
    """Return the truth of one sensor as the side file has it.

    Shape of ``t_ns``: (n,), as the motion's times.
    """
    columns: dict[str, Any] = {"t_ns": t_ns}
    for field, names in TRUTH_COLUMNS:
        columns |= dict(zip(names.split(), getattr(motion, field).T, strict=True))
    return pl.DataFrame(columns | {"still": motion.still.astype(np.int8)})


class _Text:
    """The device's text: CRLF, a blank line after every row; and what the terminal does to it."""

    def __init__(self, line: Line, start_ms: int) -> None:
        self._line = line
        self._start_ms = start_ms
        self._held = b""
        self._first = True

    def write(self, file: IO[bytes], stamp: NDArray[np.int64], counts: NDArray[np.int16]) -> None:
        """Add rows; the newest stay back until it is known whether they are the last."""
        table = pl.DataFrame({"t_ms": stamp % 2**32} | {f"c{k}": c for k, c in enumerate(counts.T)})
        if self._line.wall_clock:
            # The terminal's clock starts at 12:00 with the capture.
            clock = pl.Series(stamp - self._start_ms + 12 * 3_600_000).cast(pl.Datetime("ms"))
            table = table.with_columns(
                pl.concat_str(clock.dt.strftime("%H:%M:%S%.3f "), pl.col("t_ms").cast(pl.String)).alias(
                    "t_ms"
                )
            )
        data = table.write_csv(include_header=False, line_terminator="\r\n\r\n").encode()
        if self._first and data:
            self._first = False
            if self._line.cut_first:
                data = data[data.index(b"\r\n") // 2 :]
            if self._line.boot_chatter:
                data = "".join(f"{words}\r\n" for words in CHATTER).encode() + data
        file.write(self._held)
        self._held = data

    def finish(self, file: IO[bytes]) -> None:
        """Write what was held back, cut in the middle of the last row where asked."""
        if self._line.cut_last:
            body = self._held.rstrip(b"\r\n")
            start = body.rfind(b"\n") + 1
            self._held = body[: start + (len(body) - start) // 2]
        file.write(self._held)


def _packets(
    stamp: NDArray[np.int64], quats: Sequence[np.ndarray], counts: Sequence[np.ndarray]
) -> np.ndarray:
    """Return packets of both sensors in turn, (n, 2)."""
    out = np.zeros((len(stamp), 2), PACKET)
    out["start"], out["end"] = b"$", b"\r\n"
    out["t_ms"] = (stamp % 2**32)[:, None]
    for k, (quat, count) in enumerate(zip(quats, counts, strict=True)):
        out["id"][:, k] = k + 1
        out["q"][:, k] = np.clip(np.round(quat * PACKET_Q), -32768, 32767)
        out["a"][:, k], out["g"][:, k] = count[:, :3], count[:, 3:]
    return out


def _facts(simulation: Simulation, line: Line, format: str) -> dict[str, Any]:
    """Return all that is known about the walk, for the TOML side file."""
    o = simulation.options
    feet = simulation.route.footfalls
    sensors = {}
    for k in (1, 2):
        bias = simulation.imu(k).turn_on_bias
        sensors[f"imu{k}"] = {
            "turn_on_acc_bias": bias[:3].tolist(),
            "turn_on_gyr_bias": bias[3:].tolist(),
            "mount": msgspec.to_builtins(o.mount(k)),
            "errors": msgspec.to_builtins(o.imu(k)),
        }
    length = {"length_m": round(simulation.length_m, 6)} if len(feet) > 1 else {}
    return {
        "closed": simulation.route.closed,
        **length,
        "height_end_m": round(float(feet[-1, 2] - feet[0, 2]), 6),
        "steps": len(feet) - 1,
        "scenario": simulation.scenario,
        "seed": simulation.seed,
        "format": format,
        "frame": "pose of sensor 1 (truth.csv) and 2 (truth.imu2.csv), quat = rot_nb, in a level frame:"
        " z up, x along the first stride, origin at the start of sensor 1",
        "options": {
            k: v
            for k, v in msgspec.to_builtins(o).items()
            if v is not None and k not in ("imu1", "imu2", "mount1", "mount2")
        },
        "line": msgspec.to_builtins(line),
        **sensors,
    }
