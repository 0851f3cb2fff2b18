"""From a recording to estimates: ordering, pacing, the engine, results with lineage, metrics."""

from .alignment import ALIGNMENTS, align
from .api import replay
from .attachment import NOT_RAW, ChannelAttachment
from .calibrations import calibrate, load_calibration, save_calibration
from .clock import Clock, ManualClock, SystemClock
from .engine import Engine
from .evaluate import (
    Evaluation,
    RunEvaluation,
    check_thresholds,
    evaluate,
)
from .gaps import GapPolicy
from .metrics import nees_bounds
from .plan import Plan, PlannedRun, plan_runs
from .results import ReplayResult, Run
from .sinks import RecordingSink, Sink, TableSink
from .sources import (
    Batch,
    LiveSource,
    PlannedChannel,
    RecordingSource,
    Source,
    SourceFailed,
)
from .specs import EstimatorSpec, parse_estimator
from .tuning import Tuned, tune
from .view import RunView, Truth

__all__ = [
    "ALIGNMENTS",
    "NOT_RAW",
    "Batch",
    "ChannelAttachment",
    "Clock",
    "Engine",
    "EstimatorSpec",
    "Evaluation",
    "GapPolicy",
    "LiveSource",
    "ManualClock",
    "Plan",
    "PlannedChannel",
    "PlannedRun",
    "RecordingSink",
    "RecordingSource",
    "ReplayResult",
    "Run",
    "RunEvaluation",
    "RunView",
    "Sink",
    "Source",
    "SourceFailed",
    "SystemClock",
    "TableSink",
    "Truth",
    "Tuned",
    "align",
    "calibrate",
    "check_thresholds",
    "evaluate",
    "load_calibration",
    "nees_bounds",
    "parse_estimator",
    "plan_runs",
    "replay",
    "save_calibration",
    "tune",
]
