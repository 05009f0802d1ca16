"""Data sets and embedded scenes, each loader a module with `load(...) -> Scene`."""
