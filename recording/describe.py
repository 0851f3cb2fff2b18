"""The table of columns in ``docs/recording-format.md``, from the schemas themselves.

``python -m marcha.recording.describe docs/recording-format.md`` updates the page; a test demands it.
"""

from __future__ import annotations

import sys
from pathlib import Path

from .schemas import SCHEMAS, Schema

BEGIN = "<!-- columns: written by marcha.recording.describe -->"
END = "<!-- end of columns -->"

_KINDS = {
    "time": "Int64",
    "flag": "Boolean",
    "mac": "String",
    "technology": "String",
    "text": "String",
    "sigma": "Float64",
}
_INTEGERS = {"index": "UInt32", "status": "Int8", "service": "UInt16"}


def column_tables() -> str:
    """Return one Markdown table a message type: columns, units, fields, meaning."""
    return "\n".join(_table(s) for s in SCHEMAS.values())


def _table(schema: Schema) -> str:
    lines = [f"### {schema.name}", "", f"{schema.title[0].upper()}{schema.title[1:]}.", ""]
    lines += ["| column | type | unit | message field | meaning |", "|---|---|---|---|---|"]
    for group in schema.groups:
        for column in group.columns:
            name = f"`<name>{column.name}`" if schema.names else f"`{column.name}`"
            kind = _KINDS.get(column.kind) or _INTEGERS.get(column.name, "Float64")
            field = f"{schema.explode}[].{column.field}" if schema.explode else column.field
            squared = ", its square" if column.kind == "sigma" else ""
            optional = " (may be absent)" if group.optional else ""
            lines.append(f"| {name} | {kind} | {column.unit} | `{field}`{squared} | {column.doc}{optional} |")
    return "\n".join([*lines, ""])


def updated(page: str) -> str:
    """Return a page with the part between the two marks written anew."""
    head, _, rest = page.partition(BEGIN)
    _, _, tail = rest.partition(END)
    return f"{head}{BEGIN}\n\n{column_tables()}\n{END}{tail}"


if __name__ == "__main__":
    path = Path(sys.argv[1])
    path.write_text(updated(path.read_text(encoding="utf-8")), encoding="utf-8")
