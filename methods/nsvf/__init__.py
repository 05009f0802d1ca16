"""Neural Sparse Voxel Fields (Liu et al. 2020): a network of what the corners of voxels hold."""
