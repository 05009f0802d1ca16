"""KiloNeRF: a small network for each cell of a grid (Reiser et al. 2021)."""
