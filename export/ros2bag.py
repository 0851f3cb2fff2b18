"""A bag folder as ROS 2 plays it: the MCAP file and ``metadata.yaml``, version 9."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, ClassVar

import msgspec

from ..recording import Recording
from ..recording.selection import selected_topics
from .folder import whole_folder
from .mcap import McapExporter, McapOptions

METADATA = "metadata.yaml"


class Ros2BagExporter:
    """Folder with the annotated recording and ``metadata.yaml``."""

    name: ClassVar[str] = "ros2bag"
    title: ClassVar[str] = "ROS 2 bag folder: the annotated MCAP with metadata.yaml (version 9) beside it"
    suffix: ClassVar[str] = ""
    Options: ClassVar[type[msgspec.Struct]] = McapOptions

    def losses(self, rec: Recording, options: Any) -> list[str]:
        """Return nothing: the recording is inside."""
        selected_topics(rec, options)
        return []

    def export(self, rec: Recording, path: Path, options: Any, *, overwrite: bool = False) -> list[Path]:
        """Write the folder; see :class:`marcha.export.Exporter`."""
        from ..recording import open as open_recording

        name = f"{rec.path.stem or 'recording'}.mcap"
        with whole_folder(path, overwrite=overwrite, marker=METADATA) as folder:
            McapExporter().export(rec, folder / name, options)
            with open_recording(folder / name) as bag:
                (folder / METADATA).write_text(metadata_yaml(bag), encoding="utf-8")
        return [path / name, path / METADATA]


def metadata_yaml(bag: Recording) -> str:
    """Return the text of ``metadata.yaml`` of a recording, whose name is the file's."""
    q = json.dumps
    count = sum(c.count for c in bag.channels.values())
    duration = max(0, bag.end_ns - bag.start_ns)
    lines = [
        "rosbag2_bagfile_information:",
        "  version: 9",
        "  storage_identifier: mcap",
        f"  duration: {{nanoseconds: {duration}}}",
        f"  starting_time: {{nanoseconds_since_epoch: {bag.start_ns}}}",
        f"  message_count: {count}",
        "  topics_with_message_count:" if bag.channels else "  topics_with_message_count: []",
    ]
    for topic, channel in bag.channels.items():
        lines += [
            "    - topic_metadata:",
            f"        name: {q(topic, ensure_ascii=False)}",
            f"        type: {q(channel.schema)}",
            "        serialization_format: cdr",
            *_profiles(bag.sources[topic].metadata.get("offered_qos_profiles", "")),
            '        type_description_hash: ""',
            f"      message_count: {channel.count}",
        ]
    lines += [
        '  compression_format: ""',
        '  compression_mode: ""',
        f"  relative_file_paths: [{q(bag.path.name, ensure_ascii=False)}]",
        "  files:",
        f"    - path: {q(bag.path.name, ensure_ascii=False)}",
        f"      starting_time: {{nanoseconds_since_epoch: {bag.start_ns}}}",
        f"      duration: {{nanoseconds: {duration}}}",
        f"      message_count: {count}",
        "  custom_data: ~",
        '  ros_distro: ""',
    ]
    return "\n".join(lines) + "\n"


def _profiles(text: str) -> list[str]:
    """Return the profiles, which the channel has as YAML, indented; none where it states none."""
    inner = [line for line in text.splitlines() if line.strip()]
    if not inner:
        return ["        offered_qos_profiles: []"]
    return ["        offered_qos_profiles:", *(f"          {line}" for line in inner)]
