"""Raw logs to recordings: one module a format; each recognises its content and reports every defect."""

from .contract import (
    ChannelSpec,
    CommonOptions,
    Import,
    Importer,
    Report,
    ReportBuilder,
    SourceAttachment,
)
from .convert import Converted, ConvertedChannel, convert
from .registry import (
    Candidate,
    FormatInfo,
    OptionInfo,
    importers,
    known_formats,
    recognise,
)

__all__ = [
    "Candidate",
    "ChannelSpec",
    "CommonOptions",
    "Converted",
    "ConvertedChannel",
    "FormatInfo",
    "Import",
    "Importer",
    "OptionInfo",
    "Report",
    "ReportBuilder",
    "SourceAttachment",
    "convert",
    "importers",
    "known_formats",
    "recognise",
]
