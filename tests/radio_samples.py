"""Radio logs in small: the three tables, per-distance folders, spreadsheets."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

ANCHORS = {
    "a4:6c:2a:00:00:01": ("wifi", 0.0, 0.0, 2.6, -38.0, 2.1),
    "a0:e6:f8:00:00:02": ("ble", 8.0, 0.0, 0.8, -57.0, 1.7),
    "a0:e6:f8:00:00:03": ("ble", 4.0, 6.0, 0.8, -57.0, 1.7),
}


def three_tables(folder: Path, *, start_ms: int = 1_773_057_107_000, seconds: float = 6.0) -> Path:
    """Write a walk of some seconds along y = 2 at 50 Hz, at rest in the first two."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(3)
    t = np.arange(0.0, seconds, 0.02)
    moving = t > 2.0
    rows = ["timestamp,sensor,x,y,z"]
    for k, s in enumerate(t):
        ms = start_ms + round(s * 1000)
        z = 9.81 + moving[k] * 2.0 * np.sin(2 * np.pi * s / 0.5) + 0.01 * rng.standard_normal()
        rows.append(
            f"{ms},accelerometer,{0.01 * rng.standard_normal():.4f},{0.01 * rng.standard_normal():.4f},{z:.4f}"
        )
        rows.append(
            f"{ms},magnetometer,{20 + rng.standard_normal():.2f},{5.0:.2f},{-40 + rng.standard_normal():.2f}"
        )
        rows.append(f"{ms},orientation,{(350 + 4 * s) % 360:.2f},{-30 + rng.standard_normal():.2f},{2.0:.2f}")
    (folder / "inertial.csv").write_text("\n".join(rows) + "\n")
    heard = ["timestamp,mac,rssi"]
    for s in np.arange(0.0, seconds, 0.25):
        for mac, (_, x, y, z, p_d0, eta) in ANCHORS.items():
            where = np.array([1.0 + max(0.0, s - 2.0), 2.0, 1.2])
            d = np.linalg.norm(where - [x, y, z])
            heard.append(f"{start_ms + round(s * 1000)},{mac},{round(p_d0 - 10 * eta * np.log10(d))}")
    (folder / "radio.csv").write_text("\n".join(heard) + "\n")
    table = ["mac,rssi at 1 m (dBm),eta,x,y,height,technology"]
    table += [f"{m},{p},{e},{x},{y},{z},{t}" for m, (t, x, y, z, p, e) in ANCHORS.items()]
    (folder / "anchors.csv").write_text("\n".join(table) + "\n")
    return folder


def distances(
    folder: Path, metres: Sequence[float] = (0.5, 1.0, 2.0, 4.0), count: int = 120, p_d0: float = -40.0
) -> Path:
    """Write ``BLE/<d>m.txt`` of one node with η = 2."""
    folder = folder / "BLE"
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(5)
    for d in metres:
        powers = np.round(p_d0 - 20 * np.log10(d) + rng.standard_normal(count)).astype(int)
        (folder / f"{d:g}m.txt").write_text("\n".join(f"Node A: {p}" for p in powers) + "\n\n")
    return folder


def workbook(path: Path, sheets: Mapping[str, Sequence[Sequence[object]]]) -> Path:
    """Write a spreadsheet as small as the format allows (ECMA-376), strings inline."""

    def cell(row: int, column: int, value: object) -> str:
        at = f"{chr(65 + column)}{row}"
        if isinstance(value, str):
            return f'<c r="{at}" t="inlineStr"><is><t>{escape(value)}</t></is></c>'
        return f'<c r="{at}"><v>{value}</v></c>'

    main = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    rel = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    package = "http://schemas.openxmlformats.org/package/2006"
    names = list(sheets)
    listed = "".join(f'<sheet name="{n}" sheetId="{k}" r:id="rId{k}"/>' for k, n in enumerate(names, 1))
    links = "".join(
        f'<Relationship Id="rId{k}" Type="{rel}/worksheet" Target="worksheets/sheet{k}.xml"/>'
        for k in range(1, len(names) + 1)
    )
    kind = "application/vnd.openxmlformats-officedocument.spreadsheetml"
    parts = "".join(
        f'<Override PartName="/xl/worksheets/sheet{k}.xml" ContentType="{kind}.worksheet+xml"/>'
        for k in range(1, len(names) + 1)
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as out:
        out.writestr(
            "[Content_Types].xml",
            f'<Types xmlns="{package}/content-types"><Default Extension="rels" '
            'ContentType="application/vnd.openxmlformats-package.relationships+xml"/><Override '
            f'PartName="/xl/workbook.xml" ContentType="{kind}.sheet.main+xml"/>{parts}</Types>',
        )
        out.writestr(
            "_rels/.rels",
            f'<Relationships xmlns="{package}/relationships"><Relationship Id="rId1" Type="{rel}/officeDocument" '
            'Target="xl/workbook.xml"/></Relationships>',
        )
        out.writestr(
            "xl/workbook.xml",
            f'<workbook xmlns="{main}" xmlns:r="{rel}"><sheets>{listed}</sheets></workbook>',
        )
        out.writestr(
            "xl/_rels/workbook.xml.rels",
            f'<Relationships xmlns="{package}/relationships">{links}</Relationships>',
        )
        for k, name in enumerate(names, 1):
            rows = "".join(
                f'<row r="{r}">' + "".join(cell(r, c, v) for c, v in enumerate(row)) + "</row>"
                for r, row in enumerate(sheets[name], 1)
            )
            out.writestr(
                f"xl/worksheets/sheet{k}.xml",
                f'<worksheet xmlns="{main}"><sheetData>{rows}</sheetData></worksheet>',
            )
    return path


def fingerprints(seed: int = 1, exchanged: bool = False, points: int = 140) -> list[list[object]]:
    """Return rows ``x, y, RSSI A, RSSI B, RSSI C`` without signs, on a floor of 4 m × 4 m."""
    rng = np.random.default_rng(seed)
    at = {"A": (0.0, 0.0), "B": (0.0, 4.0), "C": (4.0, 0.0)}
    rows: list[list[object]] = [["x", "y", *(f"RSSI {a}" for a in at)]]
    for _ in range(points):
        x, y = rng.uniform(0.2, 3.8, 2).round(2).tolist()
        powers = [
            45 + 20 * np.log10(np.hypot(x - a, y - b)) + 2 * rng.standard_normal() for a, b in at.values()
        ]
        a, b, c = (float(np.round(p)) for p in powers)
        rows.append([x, y, a, c, b] if exchanged else [x, y, a, b, c])
    return rows
