"""Annotating by eye: a page for the browser of this machine, and the native Rerun viewer with a terminal.

Both edit a :class:`~marcha.viz.annotating.session.Session`.
"""

from .page import annotate_page

__all__ = ["annotate_page"]
