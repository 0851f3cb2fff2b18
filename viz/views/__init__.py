"""What each kind of channel looks like, by domain; :mod:`marcha.viz.views.base` is the contract."""

from .base import Role, View, role_of

__all__ = ["Role", "View", "role_of"]
