"""TextGrid files of Praat, long and short form."""

from __future__ import annotations

import re
from pathlib import Path

import polars as pl

from ...recording.errors import MarchaError
from .side import Label, lane_names, lanes, nanoseconds, utf8

name = "textgrid"
title = "Praat TextGrid: a tier of intervals or points each; overlaps of a tier in numbered tiers"
suffix = ".TextGrid"


def limits(rows: pl.DataFrame) -> list[str]:
    """Return what the format cannot hold of these annotations."""
    losses = ["id, source, confidence, note, channel and metadata have no place"]
    if any(lane for _, lane in _lanes(rows)):
        losses.append("labels of a tier may not overlap: they are moved to numbered tiers")
    kinds = rows.group_by("tier").agg((pl.col("start_ns") == pl.col("end_ns")).n_unique())
    if (kinds[kinds.columns[1]] > 1).any():
        losses.append("a tier holds intervals or points: tiers with both are split")
    if (rows["label"] == "").any():
        losses.append("an interval without text is space between labels")
    return losses


def _lanes(rows: pl.DataFrame) -> list[tuple[bool, int]]:
    """Return whether each annotation is a point, and its lane."""
    times = rows.select("tier", "start_ns", "end_ns").rows()
    levels = lanes((f"{a == b} {tier}", a, max(b, a + 1)) for tier, a, b in times)
    return [(a == b, lane) for (_, a, b), lane in zip(times, levels, strict=True)]


def labels(rows: pl.DataFrame, origin_ns: int) -> list[Label]:
    """Return the labels as the file will hold them."""
    keys = list(zip(rows["tier"].to_list(), _lanes(rows), strict=True))
    names = lane_names(keys)
    return [
        Label(names[key], start - origin_ns, end - origin_ns, label, {}, "point" if key[1][0] else None)
        for key, (start, end, label) in zip(
            keys, rows.select("start_ns", "end_ns", "label").rows(), strict=True
        )
    ]


def text(placed: list[Label], end_ns: int) -> str:
    """Return the file in its long form."""
    most = _seconds(max([end_ns, 1, *(label.end_ns for label in placed)]))
    tiers: dict[str, list[Label]] = {}
    for label in placed:
        tiers.setdefault(label.tier, []).append(label)
    out = [
        f'File type = "ooTextFile"\nObject class = "TextGrid"\n\nxmin = 0\nxmax = {most}\n'
        f"tiers? <exists>\nsize = {len(tiers)}\nitem []:\n"
    ]
    for number, (tier, members) in enumerate(tiers.items(), 1):
        points = members[0].source == "point"
        kind = "TextTier" if points else "IntervalTier"
        rows = members if points else _filled(members, max([end_ns, 1, *(x.end_ns for x in placed)]))
        what = "points" if points else "intervals"
        out.append(
            f'    item [{number}]:\n        class = "{kind}"\n        name = {_quoted(tier)}\n'
            f"        xmin = 0\n        xmax = {most}\n        {what}: size = {len(rows)}\n"
        )
        for k, label in enumerate(rows, 1):
            out.append(f"        {what} [{k}]:\n")
            if points:
                out.append(f"            number = {_seconds(label.start_ns)}\n            mark = ")
            else:
                out.append(
                    f"            xmin = {_seconds(label.start_ns)}\n"
                    f"            xmax = {_seconds(label.end_ns)}\n            text = "
                )
            out.append(_quoted(label.text) + "\n")
    return "".join(out)


def _filled(members: list[Label], end_ns: int) -> list[Label]:
    """Return the intervals of a tier with nothing in between: Praat wants no gaps."""
    out, until_ns = [], 0
    for label in members:
        if label.start_ns > until_ns:
            out.append(Label(label.tier, until_ns, label.start_ns, ""))
        out.append(label)
        until_ns = label.end_ns
    if until_ns < end_ns:
        out.append(Label(members[0].tier, until_ns, end_ns, ""))
    return out


def _quoted(text: str) -> str:
    return '"' + text.replace('"', '""') + '"'


def _seconds(t_ns: int) -> str:
    sign = "-" if t_ns < 0 else ""
    whole, rest = divmod(abs(t_ns), 10**9)
    return f"{sign}{whole}.{rest:09d}".rstrip("0").rstrip(".")


def sniff(path: Path, head: bytes) -> bool:
    """Return whether the file begins as Praat writes it."""
    return b"ooTextFile" in head[:200].replace(b"\0", b"") or head.startswith(b"ooBinaryFile")


_TOKEN = re.compile(
    r'"(?P<string>(?:[^"]|"")*)"|<(?P<flag>\w+)>'
    r"|(?<!\S)(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?!\S)|(?<!\S)!.*"
)
"""What Praat reads of a text file: strings, flags, and numbers that stand free; the rest is for people."""


class _Tokens:
    """The tokens of a file, one behind the other."""

    def __init__(self, path: Path, content: str) -> None:
        self.path = path
        self.content = content
        self.matches = (m for m in _TOKEN.finditer(content) if m.lastgroup)
        self.at = 0

    def take(self, kind: str, what: str) -> str:
        """Return the next token.

        Raises
        ------
        MarchaError
            It is of another kind, or the file ends.
        """
        match = next(self.matches, None)
        if match is None:
            raise MarchaError(f"{self.path}: ends where {what} is expected; it was cut short: save it again")
        self.at = match.start()
        if match.lastgroup != kind:
            raise MarchaError(
                f"{self.path}: line {self.line}: {match[0][:40]!r} stands where {what} is expected"
            )
        return match[kind]

    @property
    def line(self) -> int:
        return self.content.count("\n", 0, self.at) + 1

    def string(self, what: str) -> str:
        return self.take("string", what).replace('""', '"')

    def time(self, what: str) -> tuple[int, str]:
        text = self.take("number", what)
        return nanoseconds(self.path, 0, text), text

    def count(self, what: str) -> int:
        text = self.take("number", what)
        if not text.isdigit() or int(text) > len(self.content):
            raise MarchaError(f"{self.path}: line {self.line}: {text} is no number of {what}")
        return int(text)


def read(path: Path, data: bytes) -> list[Label]:
    """Return the labels of a file; intervals without text are the space between them.

    Raises
    ------
    MarchaError
        The file is cut short, binary, or not what Praat writes.
    """
    if data.startswith(b"ooBinaryFile"):
        raise MarchaError(f"{path}: is a binary TextGrid; save it in Praat as text file")
    tokens = _Tokens(path, utf8(path, data))
    if tokens.string("the type of file") not in ("ooTextFile", "ooTextFile short"):
        raise MarchaError(f"{path}: line 1: is no text file of Praat")
    kind = tokens.string("the class")
    if kind != "TextGrid":
        raise MarchaError(
            f"{path}: line 2: holds a {kind[:40]}, not a TextGrid; select the TextGrid and save it"
        )
    tokens.time("xmin")
    tokens.time("xmax")
    if tokens.take("flag", "<exists>") != "exists":
        return []
    out: list[Label] = []
    for _ in range(tokens.count("tiers")):
        out += _read_tier(path, tokens)
    order = {id(label): k for k, label in enumerate(out)}
    return sorted(out, key=lambda label: (label.start_ns, order[id(label)]))


def _read_tier(path: Path, tokens: _Tokens) -> list[Label]:
    kind, tier = tokens.string("the class of a tier"), tokens.string("the name of a tier")
    if kind not in ("IntervalTier", "TextTier"):
        raise MarchaError(f"{path}: line {tokens.line}: tier {tier[:40]!r}: unknown class {kind[:40]!r}")
    tokens.time("xmin")
    tokens.time("xmax")
    out = []
    for _ in range(tokens.count("labels")):
        start, stated = tokens.time("a time")
        end, until = tokens.time("a time") if kind == "IntervalTier" else (start, stated)
        if end < start:
            raise MarchaError(
                f"{path}: line {tokens.line}: tier {tier[:40]!r}: ends at {until}, before {stated}"
            )
        text = tokens.string("a text")
        out.append(Label(tier, start, end, text, filler=kind == "IntervalTier" and not text.strip()))
    return out
