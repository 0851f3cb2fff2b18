"""Published extremes beside the measured ones, in a study's report."""

from __future__ import annotations

from html import escape
from typing import Any

import polars as pl

from ..viz.page import Html


def extremes(html: Html, published: pl.DataFrame) -> None:
    """Tabulate maximum, minimum and mean beside the published ones, where a source states extremes."""
    part = published.filter(pl.col("published_max").is_not_null())
    if not len(part):
        return
    html.heading("Maximum, minimum and mean, beside the published ones")

    def three(row: dict[str, Any], of: str) -> str:
        values = [row[f"{of}_max"], row[f"{of}_min"], row[of]]
        return " / ".join("–" if v is None else f"{v:.2f}" for v in values)

    rows = [
        [
            escape(r["table"]),
            escape(r["filter"]),
            escape(r["configuration"]),
            escape(f"{r['metric']} ({r['unit']})"),
            three(r, "measured"),
            str(r["n"]),
            f"@published {three(r, 'published')}",
        ]
        for r in part.iter_rows(named=True)
    ]
    html.table(["table", "filter", "configuration", "metric", "measured", "n", "published"], rows, 4)
