"""Data sets and embedded scenes. Each loader is a module with `load(...) -> Scene`.

A loader raises SteerbenchError, naming file and field, if the data are not as described.
"""
