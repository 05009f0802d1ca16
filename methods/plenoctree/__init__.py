"""PlenOctree (Yu et al. 2021): a sparse grid of densities and spherical harmonics."""
