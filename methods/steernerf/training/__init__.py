"""Stage 2 of SteerNeRF (Section 3.4): the 2D renderer and the field, on patches."""
