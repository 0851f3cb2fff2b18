"""Simulated phones in the layouts of logger apps: what the tests of importers read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from marcha.ingest.simulate import PhoneWalk, phone_walk


def short_walk(**options: Any) -> PhoneWalk:
    """Return a phone that rests, then is carried 10 m: about 800 samples at 50 Hz."""
    settings: dict[str, Any] = {"rate_hz": 50, "gnss_hz": 1, "rest_s": 4} | options
    return phone_walk("phone-10m", **settings)


def table(path: Path, header: str, rows: np.ndarray, separator: str = ",", digits: str = "%.10g") -> Path:
    """Write a table of numbers below a header."""
    lines = [separator.join(digits % v for v in row) for row in rows]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([header, *lines, ""]), encoding="utf-8")
    return path


def seconds(walk: PhoneWalk, t_ns: np.ndarray | None = None) -> np.ndarray:
    return ((walk.t_ns if t_ns is None else t_ns) - walk.t_ns[0]) / 1e9


def fixes(walk: PhoneWalk) -> np.ndarray:
    """Return t (s), latitude, longitude, height, speed, course, accuracies: phyphox's columns."""
    f = walk.fixes
    columns = [
        seconds(walk, f["t_ns"].to_numpy()),
        *(f[c].to_numpy() for c in ("lat_deg", "lon_deg", "alt_m")),
    ]
    accuracy = f["sd_east_m"].to_numpy() * np.sqrt(-2 * np.log(0.32))
    return np.column_stack([*columns, *velocity(walk), accuracy, f["sd_up_m"].to_numpy()])


def velocity(walk: PhoneWalk) -> tuple[np.ndarray, np.ndarray]:
    """Return speed (m/s) and course (degrees clockwise from north) of the receiver at the fixes."""
    east, north = (walk.fixes[c].to_numpy() for c in ("vel_east", "vel_north"))
    return np.hypot(east, north), np.degrees(np.arctan2(east, north)) % 360


def phyphox(folder: Path, walk: PhoneWalk, separator: str = ",") -> Path:
    """Write phyphox's folder; the header is quoted as the app does."""
    t = seconds(walk)

    def write(name: str, cells: list[str], rows: np.ndarray) -> None:
        header = separator.join(f'"{c}"' for c in cells)
        table(folder / name, header, rows, separator, "%.9E")

    for name, unit, values in (
        ("Accelerometer", "m/s^2", walk.acc_b),
        ("Gyroscope", "rad/s", walk.gyr_b),
        ("Magnetometer", "µT", walk.mag_b * 1e6),
    ):
        write(f"{name}.csv", ["Time (s)", *(f"{a} ({unit})" for a in "XYZ")], np.column_stack((t, values)))
    names = ["Latitude (°)", "Longitude (°)", "Height (m)", "Velocity (m/s)", "Direction (°)"]
    names += ["Horizontal Accuracy (m)", "Vertical Accuracy (°)"]
    header = separator.join(f'"{c}"' for c in ["Time (s)", *names])
    table(folder / "Location.csv", header, fixes(walk), separator, "%.15E")
    return folder


ANDROSENSOR = (
    *(f"ACCELEROMETER {a} (m/s²)" for a in "XYZ"),
    *(f"GYROSCOPE {a} (rad/s)" for a in "XYZ"),
    *(f"MAGNETIC FIELD {a} (μT)" for a in "XYZ"),
    "LOCATION Latitude : ",
    "LOCATION Longitude : ",
    "LOCATION Altitude ( m)",
    "LOCATION Speed ( Kmh)",
    "LOCATION Accuracy ( m)",
    "LOCATION ORIENTATION (°)",
    "Time since start in ms ",
    "YYYY-MO-DD HH-MI-SS_SSS",
)


def held_fixes(walk: PhoneWalk) -> np.ndarray:
    """Return latitude, longitude, height and accuracy on every sample: the last one so far, NaN before the first."""
    return held(walk, fixes(walk)[:, [1, 2, 3, 6]])


def held(walk: PhoneWalk, values: np.ndarray) -> np.ndarray:
    """Return values of the fixes on every sample: the last one so far, NaN before the first."""
    at = np.searchsorted(walk.fixes["t_ns"].to_numpy(), walk.t_ns, side="right") - 1
    out = values[np.maximum(at, 0)]
    out[at < 0] = np.nan
    return out


def androsensor(path: Path, walk: PhoneWalk) -> Path:
    """Write AndroSensor's table: empty cells before the first fix, milliseconds behind a colon."""
    *place, accuracy = held_fixes(walk).T
    kmh, course = held(walk, np.column_stack(velocity(walk)) * (3.6, 1.0)).T
    location = np.column_stack((*place, kmh, accuracy, course))
    rows = np.hstack((walk.acc_b, walk.gyr_b, walk.mag_b * 1e6, location))
    ms = np.round(seconds(walk) * 1e3).astype(int)
    lines = [",".join(ANDROSENSOR)]
    for row, t in zip(rows, ms, strict=True):
        cells = ["" if np.isnan(v) else f"{v:.10g}" for v in row]
        wall = f"2026-03-09 08:51:{47 + t // 1000:02d}:{t % 1000:03d}"
        lines.append(",".join([*cells, str(t), wall]))
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


SENSORTESTER = (
    "TimeStamp[ms];Prox[Cm];AccX[m/s^2];AccY[m/s^2];AccZ[m/s^2];GyroX[rad/s];GyroY[rad/s];GyroZ[rad/s];"
    "MagnX[uT];MagnY[uT];MagnZ[uT];Press[Pa];Lat;Lng"
)


def sensortester(path: Path, walk: PhoneWalk) -> Path:
    """Write SensorTester's table: hPa under a header of Pa, ``-`` where there is nothing."""
    place = held_fixes(walk)
    lines = [SENSORTESTER]
    for k, t in enumerate(walk.t_ns // 1_000_000):
        values = [*walk.acc_b[k], *walk.gyr_b[k], *walk.mag_b[k] * 1e6, 938.2 + k // 20 * 0.01, *place[k, :2]]
        lines.append(";".join([str(t), "-", *("-" if np.isnan(v) else f"{v:.10g}" for v in values)]))
    path.write_text("\n".join([*lines, ""]), encoding="utf-8")
    return path


def indoor_location(path: Path, walk: PhoneWalk) -> Path:
    """Write rows of the indoor-location apps, a signal out of order, waypoints at both ends."""
    ms = walk.t_ns // 1_000_000
    quat = np.where(walk.quat_wxyz[:, :1] < 0, -walk.quat_wxyz, walk.quat_wxyz)
    rows = ["#\tstartTime:1", "#\tSiteName:Mall\tFloorName:F1", "#\tBrand:Acme\tModel:One\t"]
    rows.append(f"{ms[0]}\tTYPE_WAYPOINT\t143.9522\t85.64752")
    for k, t in enumerate(ms):
        for kind, values in (
            ("ACCELEROMETER", walk.acc_b[k]),
            ("GYROSCOPE", walk.gyr_b[k]),
            ("MAGNETIC_FIELD", walk.mag_b[k] * 1e6),
            ("ROTATION_VECTOR", quat[k, 1:]),
        ):
            rows.append("\t".join([str(t), f"TYPE_{kind}", *(f"{v:.9g}" for v in values), "3"]))
        if k % 100 == 50:
            rows.append(f"{t}\tTYPE_WIFI\tguest\t16:74:9C:2B:4D:1B\t-41\t5825\t{t - 300}")
            rows.append(f"{t - 40}\tTYPE_BEACON\t9195B3AD\t0\t0\t-56\t-89\t32.1\tE0:78:A3:3D:B5:AB\t{t}")
            rows.append(f"{t}\tTYPE_BLUE\tw36\tE0:78:A3:3D:B5:AB\t-89")
    rows.append(f"{ms[-1]}\tTYPE_WAYPOINT\t137.1\t88.0")
    path.write_text("\n".join([*rows, ""]), encoding="utf-8")
    return path


def android_ns(folder: Path, walk: PhoneWalk) -> Path:
    """Write a folder of sensor events and of two feet's contacts."""
    folder.mkdir(parents=True, exist_ok=True)
    boot = 263_415_142_248_209
    t = walk.t_ns - walk.t_ns[0] + boot
    for name, values in (("accelerometer", walk.acc_b), ("gyroscope", walk.gyr_b)):
        rows = (f"{a},3," + ",".join(f"{v:.9g}" for v in row) for a, row in zip(t, values, strict=True))
        (folder / f"{name}.csv").write_text("\r\n".join(rows) + "\r\n")
    down = walk.steps["end_ns"].to_numpy() - walk.t_ns[0] + boot
    grid = np.arange(t[0], t[-1], 97_000_000)
    feet = np.stack([_on_ground(grid, down[k::2]) for k in (0, 1)])
    (folder / "stepcounter.csv").write_text(
        "\n".join(f"{g},{a},{b}" for g, a, b in zip(grid, *feet, strict=True))
    )
    (folder / "metadata.txt").write_text("accelerometer : MPU6515 Accelerometer\n")
    return folder


def _on_ground(grid: np.ndarray, contacts: np.ndarray) -> np.ndarray:
    """1 for 0.6 s from every contact of a foot."""
    since = grid - contacts[np.maximum(np.searchsorted(contacts, grid, side="right") - 1, 0)]
    return ((since >= 0) & (since < 600_000_000)).astype(int)


def rtk_pos(path: Path, walk: PhoneWalk) -> Path:
    """Write the true track as a survey in degrees, minutes and seconds."""
    stamps = walk.t_ns[::5].astype("datetime64[ns]")
    metre = 1 / 111_000
    rows = ["YEAR-MM-DD HR:MN:SS.SSS  LAT(d) LAT(m) LAT(s) LON(d)   LON(m)LON(s)        HGT(m)"]
    for at, pos in zip(stamps, walk.pos[::5], strict=True):
        cells = []
        for value in (walk.options.lat_deg + pos[1] * metre, walk.options.lon_deg + pos[0] * metre):
            size = abs(value)
            minutes = (size - int(size)) * 60
            cells.append(
                f"{'-' if value < 0 else ''}{int(size)} {int(minutes)} {(minutes - int(minutes)) * 60:.5f}"
            )
        date, time = str(at)[:23].split("T")
        rows.append(f"{date} {time}   {cells[0]}   {cells[1]}   {walk.options.alt_m + pos[2]:.3f}")
    path.write_text("\r\n".join([*rows, ""]))
    return path


def android_text(path: Path, walk: PhoneWalk, columns: int = 10) -> Path:
    """Write the Android text of the source: @ lines, rows that end in #."""
    place = held_fixes(walk)
    rows = ["@Date: Mon Mar 09 08:51:47 GMT-03:00 2026", "@ SamplingTime: 50ms", ""]
    for k, t in enumerate(walk.t_ns // 1_000_000):
        if not np.isnan(place[k, 0]):
            values = [*walk.acc_b[k], *walk.mag_b[k] * 1e6, *place[k, :3]][: columns - 1]
            rows.append(f"{t}," + ",".join(f"{v:.12g}" for v in values) + "#")
    path.write_text("\n".join([*rows, ""]))
    return path


def getsensordata(path: Path, walk: PhoneWalk) -> Path:
    """Write typed rows with two clocks: the app's is up to 4 ms late, the sensor's began elsewhere."""
    rows = ["% GetSensorData", "% Date of recording: Mon Mar 09 08:51:47"]
    late = np.random.default_rng(1).uniform(0, 0.004, len(walk.t_ns))
    for k, s in enumerate(seconds(walk)):
        for kind, values in (("ACCE", walk.acc_b[k]), ("GYRO", walk.gyr_b[k]), ("MAGN", walk.mag_b[k] * 1e6)):
            rows.append(
                f"{kind};{s + late[k]:.6f};{s + 9000:.6f};" + ";".join(f"{v:.9g}" for v in values) + ";3"
            )
        if k % 100 == 10:
            rows.append(f"WIFI;{s:.3f};{s + 9000:.3f};guest;16:74:9c:2b:4d:1b;-41;")
    o = walk.options
    rows.append(f"POSI;{seconds(walk)[-1]:.3f};1;{o.lat_deg};{o.lon_deg};0;0")
    path.write_text("\n".join([*rows, ""]))
    return path


GETSENSORDATA_HEAD = """% LogFile created by the 'GetSensorData' App for Android.
% Date of creation: Mon Mar 09 08:51:47 GMT-03:00 2026
% Developed by LOPSI research group at CAR-CSIC, Spain (http://www.car.upm-csic.es/lopsi)
% Version 2.1 January 2018
%
% Phone used for this logfile:
% Manufacturer:            \tsamsung
%
% LogFile Data format:
% Accelerometer data: \t'ACCE;AppTimestamp(s);SensorTimestamp(s);Acc_X(m/s^2);Acc_Y(m/s^2);Acc_Z(m/s^2);Accuracy(integer)'
% Gyroscope data:     \t'GYRO;AppTimestamp(s);SensorTimestamp(s);Gyr_X(rad/s);Gyr_Y(rad/s);Gyr_Z(rad/s);Accuracy(integer)'
% Magnetometer data:  \t'MAGN;AppTimestamp(s);SensorTimestamp(s);Mag_X(uT);;Mag_Y(uT);Mag_Z(uT);Accuracy(integer)'
% Pressure data:      \t'PRES;AppTimestamp(s);SensorTimestamp(s);Pres(mbar);Accuracy(integer)'
% Orientation data:   \t'AHRS;AppTimestamp(s);SensorTimestamp(s);PitchX(deg);RollY(deg);YawZ(deg);Quat(2);Quat(3);Quat(4);Accuracy(int)'
% GNSS/GPS data:      \t'GNSS;AppTimestamp(s);SensorTimeStamp(s);Latit(deg);Long(deg);Altitude(m);Bearing(deg);Accuracy(m);Speed(m/s);SatInView;SatInUse'
% WIFI data:          \t'WIFI;AppTimestamp(s);SensorTimeStamp(s);Name_SSID;MAC_BSSID;Frequency;RSS(dBm);'
% Bluetooth data:     \t'BLUE;AppTimestamp(s);Name;MAC_Address;RSS(dBm);'
% BLE 4.0 data:       \t'BLE4;AppTimestamp(s);iBeacon;MAC;RSSI(dBm);Power;MajorID;MinorID;UUID'
% BLE 4.0 data:       \t'BLE4;AppTimestamp(s);Eddystone;MAC;RSSI(dBm);instanceID;OptionalTelemetry[voltaje;temperature]'
% Sound data:         \t'SOUN;AppTimestamp(s);RMS;Pressure(Pa);SPL(dB);'
% POSI Reference:    \t\t'POSI;Timestamp(s);Counter;Latitude(degrees); Longitude(degrees);floor ID(0,1,2..4);Building ID(0,1,2..3);'
%
"""  # noqa: E501
"""The head of version 2.1, as the app writes it (the doubled semicolon is its own)."""


def getsensordata_21(path: Path, walk: PhoneWalk) -> Path:
    """Write what version 2.1 writes: declared columns, other columns of signals, satellites, sound, no accuracy."""
    rows = [GETSENSORDATA_HEAD]
    quat = np.where(walk.quat_wxyz[:, :1] < 0, -walk.quat_wxyz, walk.quat_wxyz)
    for k, s in enumerate(seconds(walk)):
        both = f"{s:.3f};{s + 1527.1:.4f}"
        rows.append(f"ACCE;{both};" + ";".join(f"{v:.5f}" for v in walk.acc_b[k]) + ";3")
        rows.append(f"MAGN;{both};" + ";".join(f"{v:.5f}" for v in walk.mag_b[k] * 1e6) + ";3")
        rows.append(f"AHRS;{both};1.0;2.0;3.0;" + ";".join(f"{v:.8f}" for v in quat[k, 1:]) + ";3")
        if k % 100 == 10:
            rows.append(f"WIFI;{s:.3f};{s + 1527:.3f};eduroam;16:74:9c:2b:4d:1b;2412;-41")
            rows.append(
                f"BLE4;{s:.3f};iBeacon;e0:78:a3:3d:b5:ab;-77;-59;1;2;b9407f30-f5f8-466e-aff9-25556b57fe6d"
            )
            rows.append(f"BLE4;{s:.3f};Eddystone;e0:78:a3:3d:b5:ac;-80;0102")
            rows.append(f"BLUE;{s:.3f};watch;e0:78:a3:3d:b5:ad;-60")
            rows.append(f"SOUN;{s:.3f};210.1;0.02;61.2")
    for f, speed, course in zip(walk.fixes.iter_rows(named=True), *velocity(walk), strict=True):
        s = (f["t_ns"] - walk.t_ns[0]) / 1e9
        place = f"{f['lat_deg']:.8f};{f['lon_deg']:.8f};{f['alt_m']:.3f}"
        rows.append(f"GNSS;{s:.3f};{f['t_ns'] / 1e9:.3f};{place};{course:.6f};4.5;{speed:.6f};20;9")
    o = walk.options
    rows.append(f"POSI;{seconds(walk)[-1]:.3f};1;{o.lat_deg};{o.lon_deg};0;0")
    path.write_text("\n".join([*rows, ""]))
    return path


def gnsslogger_v3(path: Path, walk: PhoneWalk) -> Path:
    """Write GnssLogger 3's text: satellites' rows between, three providers, rates with drift, orientation.

    UTC is cut to whole milliseconds, beside the nanoseconds since boot.
    """
    rows = [
        "# ",
        "# Header Description:",
        "# ",
        "# Version: v3.0.6.4 Platform: 13 Manufacturer: Google Model: Pixel 6",
    ]
    rows += ["# ", "# Raw,utcTimeMillis,TimeNanos,LeapSecond,TimeUncertaintyNanos,Svid", "# "]
    for kind, unit, bias in (
        ("Accel", "Mps2", "Bias"),
        ("Gyro", "RadPerSec", "Drift"),
        ("Mag", "MicroT", "Bias"),
    ):
        axes = ",".join(f"Uncal{kind}{a}{unit}" for a in "XYZ")
        more = ",".join(f"{bias}{a}{unit}" for a in "XYZ")
        rows.append(f"# Uncal{kind},utcTimeMillis,elapsedRealtimeNanos,{axes},{more}")
        rows.append(
            f"# {kind},utcTimeMillis,elapsedRealtimeNanos," + ",".join(f"{kind}{a}{unit}" for a in "XYZ")
        )
    rows += ["# OrientationDeg,utcTimeMillis,elapsedRealtimeNanos,yawDeg,rollDeg,pitchDeg", "# "]
    rows.append(
        "# Fix,Provider,LatitudeDegrees,LongitudeDegrees,AltitudeMeters,SpeedMps,AccuracyMeters,BearingDegrees,"
        "UnixTimeMillis,SpeedAccuracyMps,BearingAccuracyDegrees,elapsedRealtimeNanos,VerticalAccuracyMeters,MockLocation"
    )
    boot = int(walk.t_ns[0]) - 65_972_055_195_160
    for f, speed, course in zip(walk.fixes.iter_rows(named=True), *velocity(walk), strict=True):
        for provider, off in (("GPS", 0.0), ("FLP", 2e-5), ("NLP", 3e-3)):
            rows.append(
                f"Fix,{provider},{f['lat_deg'] + off:.10f},{f['lon_deg']:.10f},{f['alt_m']:.9f},{speed:.7f},4.5,"
                f"{course:.6f},"
                f"{f['t_ns'] // 1_000_000},,,{f['t_ns'] - boot},11.185,0"
            )
    rows += ["Status,1663712658000,18,0,1,1,,12.80,285.0,16.0,1,1,0,", "Nav,3,769,1,-1,14,116,5,-126,11"]
    for k, t in enumerate(walk.t_ns.tolist()):
        at = f"{t // 1_000_000},{t - boot}"
        gyr, mag = walk.gyr_b[k] + 0.25, walk.mag_b[k] * 1e6 + 200
        rows.append(f"UncalAccel,{at}," + ",".join(f"{v:.9g}" for v in walk.acc_b[k]) + ",0.0,0.0,0.0")
        rows.append(f"UncalGyro,{at}," + ",".join(f"{v:.9g}" for v in gyr) + ",0.25,0.25,0.25")
        rows.append(f"UncalMag,{at}," + ",".join(f"{v:.9g}" for v in mag) + ",200,200,200")
        rows.append(f"OrientationDeg,{at},201.0,-5.0,-52.0")
        rows.append(f"Raw,{t // 1_000_000},32083712000000,18,,7")
    path.write_text("\n".join([*rows, ""]))
    return path


def gnsslogger(path: Path, walk: PhoneWalk) -> Path:
    """Write GnssLogger's text: uncalibrated readings with their bias."""
    rows = [
        "# Version: v3",
        "# Fix,Provider,LatitudeDegrees,LongitudeDegrees,AltitudeMeters,SpeedMps,AccuracyMeters,BearingDegrees,"
        "UnixTimeMillis",
    ]
    for kind, unit in (("Accel", "Mps2"), ("Gyro", "RadPerSec"), ("Mag", "MicroT")):
        axes = ",".join(f"Uncal{kind}{a}{unit}" for a in "XYZ")
        drift = "Drift" if kind == "Gyro" else "Bias"
        bias = ",".join(f"{'Bias' if drift == 'Bias' else 'Drift'}{a}{unit}" for a in "XYZ")
        rows.append(f"# Uncal{kind},utcTimeMillis,elapsedRealtimeNanos,{axes},{bias}")
    for f in walk.fixes.iter_rows(named=True):
        rows.append(
            f"Fix,GPS,{f['lat_deg']:.9f},{f['lon_deg']:.9f},{f['alt_m']:.3f},1.2,4.5,,{f['t_ns'] // 1_000_000}"
        )
    rows.append("Raw,1,2,3")
    for k, t in enumerate(walk.t_ns // 1_000_000):
        for kind, values, bias in (
            ("Accel", walk.acc_b[k] + 0.5, 0.5),
            ("Mag", walk.mag_b[k] * 1e6 + 20, 20),
        ):
            cells = [*(f"{v:.9g}" for v in values), *[str(bias)] * 3]
            rows.append(f"Uncal{kind},{t},{t * 1000}," + ",".join(cells))
    path.write_text("\n".join([*rows, ""]))
    return path


def gpx(path: Path, walk: PhoneWalk) -> Path:
    """Write a GPX track of the fixes."""
    points = "".join(
        f'<trkpt lat="{f["lat_deg"]:.9f}" lon="{f["lon_deg"]:.9f}"><ele>{f["alt_m"]:.2f}</ele>'
        f"<time>{np.datetime64(f['t_ns'], 'ns').astype('datetime64[ms]')}Z</time></trkpt>"
        for f in walk.fixes.iter_rows(named=True)
    )
    path.write_text(
        f'<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{points}</trkseg></trk></gpx>'
    )
    return path


def kml(path: Path, walk: PhoneWalk) -> Path:
    """Write a KML gx:Track of the fixes."""
    rows = list(walk.fixes.iter_rows(named=True))
    when = "".join(f"<when>{np.datetime64(f['t_ns'], 'ns').astype('datetime64[ms]')}Z</when>" for f in rows)
    coord = "".join(
        f"<gx:coord>{f['lon_deg']:.9f} {f['lat_deg']:.9f} {f['alt_m']:.2f}</gx:coord>" for f in rows
    )
    spaces = 'xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"'
    path.write_text(f"<kml {spaces}><Placemark><gx:Track>{when}{coord}</gx:Track></Placemark></kml>")
    return path


def sensor_logger(folder: Path, walk: PhoneWalk, platform: str = "android", standard: bool = False) -> Path:
    """Write Sensor Logger's folder: the accelerometer without gravity; iOS turns both unless standardised."""
    sign = -1.0 if platform == "ios" and not standard else 1.0
    gravity = np.tile(walk.acc_b[:100].mean(axis=0), (len(walk.t_ns), 1))
    elapsed = seconds(walk)
    folder.mkdir(parents=True, exist_ok=True)
    for name, values in (
        ("Accelerometer", sign * (walk.acc_b - gravity)),
        ("Gravity", sign * gravity),
        ("Gyroscope", walk.gyr_b),
        ("Magnetometer", walk.mag_b * 1e6),
    ):
        rows = (
            f"{t},{s:.9f}," + ",".join(f"{v:.9g}" for v in row[::-1])
            for t, s, row in zip(walk.t_ns, elapsed, values, strict=True)
        )
        (folder / f"{name}.csv").write_text("\n".join(["time,seconds_elapsed,z,y,x", *rows, ""]))
    rows = [
        f"{f[0] * 1e9 + walk.t_ns[0]:.0f},{f[0]:.6f},{f[7]:.6f},{f[6]:.6f},{f[4]:.7f},{f[5]:.6f},"
        f"{f[3]:.4f},{f[2]:.12f},{f[1]:.12f}"
        for f in fixes(walk)
    ]
    head = (
        "time,seconds_elapsed,verticalAccuracy,horizontalAccuracy,speed,bearing,altitude,longitude,latitude"
    )
    (folder / "Location.csv").write_text("\n".join([head, *rows, ""]))
    notes = [
        f'{walk.t_ns[100]},{elapsed[100]:.3f},"door, left",118',
        f'{walk.t_ns[200]},{elapsed[200]:.3f},"two\nlines",95',
    ]
    head = "time,seconds_elapsed,text,millisecond_press_duration"
    (folder / "Annotation.csv").write_text("\n".join([head, *notes, ""]))
    about = f"version,device name,platform,standardisation\n3,Phone,{platform},{str(standard).lower()}\n"
    (folder / "Metadata.csv").write_text(about)
    return folder
