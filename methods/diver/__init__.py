"""DIVeR (Wu et al. 2022): corner features of voxels, integrated exactly along each ray segment."""
