"""Ours, beyond the paper: a lean 2D renderer, the field at the surface, refinement."""
