"""Data sets and embedded scenes. Each loader is a module with `load(...) -> Scene`."""
