"""Studies: recordings × estimators × parameters, with statistics, figures and one report."""

from __future__ import annotations

from .config import StudyConfig, load, presets
from .study import StudyResult, run_study

__all__ = ["StudyConfig", "StudyResult", "load", "presets", "run_study"]
