"""What every export says of where it comes from."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import msgspec

from ..recording import Recording
from ..recording.provenance import hash_file

FIRST_DATE_NS = 946_684_800 * 10**9
"""2000-01-01: clocks before it do not tell the date."""


def origin(rec: Recording) -> dict[str, Any]:
    """Return the tool, the recording with its hash, and what a time of zero stands for."""
    return {
        "tool": f"marcha {version('marcha')}",
        "recording": rec.path.name,
        "blake2b": hash_file(rec.path),
        "start_ns": rec.start_ns,
        "duration_s": rec.duration_s,
    }


def pretty(value: Any) -> bytes:
    """Return JSON for people and programs."""
    return msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n"
