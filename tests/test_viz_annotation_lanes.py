"""What a viewer shows of annotations is what there is, however often they come and go."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

import numpy as np
from marcha.viz.annotation_lanes import AnnotationLanes


class Viewer:
    """What Rerun keeps of what was logged: of one time the newest state, of points all that were not hidden."""

    prefix = ""
    runs = ("foot_9iez",)

    def __init__(self) -> None:
        self.changes: dict[str, dict[int, str]] = {}
        self.dots: dict[str, list[int]] = {}
        self.shown: list[tuple[str, str]] = []
        self.lines: list[str] = []

    def states(self, path: str, t_ns: np.ndarray, states: Sequence[str]) -> None:
        self.changes.setdefault(path, {}).update(zip(t_ns.tolist(), states, strict=True))

    def points(self, path: str, *_: object) -> None:
        assert path not in self.dots
        self.dots[path] = []

    def scalars(self, path: str, t_ns: np.ndarray, _: np.ndarray) -> None:
        self.dots[path] += t_ns.tolist()

    def static(self, path: str, archetype: Any) -> None:
        assert "visible" in repr(archetype)
        del self.dots[path]

    def text(self, path: str, t_ns: np.ndarray, text: Sequence[str]) -> None:
        self.lines += text

    def show(self, kind: str, path: str, **_: object) -> None:
        self.shown.append((kind, path))

    @property
    def bars(self) -> list[tuple[str, int, int, str]]:
        found = []
        for path, changes in self.changes.items():
            times = sorted(changes)
            for a, b in zip(times, [*times[1:], None], strict=True):
                if changes[a]:
                    assert b is not None, "a bar to the end of the recording"
                    found.append(("/".join(path.split("/")[:3]), a, b, changes[a]))
        return sorted(found)


def row(name: str, tier: str, start: int, end: int, label: str) -> dict[str, Any]:
    return {"id": name, "tier": tier, "start_ns": start, "end_ns": end, "label": label}


def expected(rows: dict[str, dict[str, Any]]) -> list[tuple[str, int, int, str]]:
    return sorted(
        (f"/annotation/{r['tier']}", r["start_ns"], r["end_ns"], r["label"] or "(no label)")
        for r in rows.values()
        if r["end_ns"] > r["start_ns"]
    )


def test_every_interval_is_one_bar_however_they_come_and_go() -> None:
    rng, viewer, rows = random.Random(4), Viewer(), {}
    lanes = AnnotationLanes(viewer)  # pyright: ignore[reportArgumentType]
    for k in range(400):
        gone = [rows.pop(name) for name in rng.sample(sorted(rows), min(len(rows), rng.randrange(3)))]
        come = [
            row(
                f"{k}.{i}",
                rng.choice("ab"),
                start := rng.randrange(100),
                start + rng.choice([0, 3, 9, 40]),
                rng.choice(["x", ""]),
            )
            for i in range(rng.randrange(4))
        ]
        if gone and rng.random() < 0.5:  # moved
            come.append({**gone[0], "end_ns": gone[0]["end_ns"] + 1})
        rows |= {r["id"]: r for r in come}
        lanes.update(come, gone)
        assert viewer.bars == expected(rows)
        dots = sorted(t for times in viewer.dots.values() for t in times)
        assert dots == sorted(r["start_ns"] for r in rows.values() if r["end_ns"] == r["start_ns"])
    assert len(rows) > 50


def test_at_first_there_are_no_more_lanes_than_needed() -> None:
    rng = np.random.default_rng(5)
    start = rng.integers(0, 1000, 200)
    end = start + rng.integers(1, 80, 200)
    viewer = Viewer()
    lanes = AnnotationLanes(viewer)  # pyright: ignore[reportArgumentType]
    lanes.update(
        row(f"{k}", "t", int(a), int(b), "x") for k, (a, b) in enumerate(zip(start, end, strict=True))
    )
    deepest = max(int(np.sum((start <= t) & (end > t))) for t in range(1100))
    assert len(viewer.changes) == deepest


def test_tiers_to_come_are_shown_and_those_of_runs_left_out() -> None:
    viewer = Viewer()
    lanes = AnnotationLanes(viewer)  # pyright: ignore[reportArgumentType]
    lanes.update([row("1", "foot_9iez/stance", 0, 5, "stance"), row("2", "t", 0, 5, "x")])
    lanes.log([row("1", "foot_9iez/stance", 0, 5, "stance"), row("2", "t", 0, 5 * 10**9, "x")])
    lanes.show_drawn()
    assert list(viewer.changes) == ["/annotation/t"]
    assert viewer.lines == ["t: x, 5.00 s"]
    assert ("lanes", "/annotation/**") in viewer.shown
    assert not any(kind == "plot" for kind, _ in viewer.shown)
