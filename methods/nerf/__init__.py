"""NeRF (Mildenhall et al. 2020): a dense network of positions and directions."""
