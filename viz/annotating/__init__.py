"""Annotating by eye: a page for the browser of this machine, and the native Rerun viewer with a terminal.

Both edit a :class:`~marcha.viz.annotating.session.Session`.
"""

from .page import annotate_page
from .session import Session
from .viewer import annotate_in_viewer

__all__ = ["Session", "annotate_in_viewer", "annotate_page"]
