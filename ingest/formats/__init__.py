"""Importers: one module a format, each registered as an entry point ``marcha.importers``."""
