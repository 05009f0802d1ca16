"""Neural Sparse Voxel Fields (Liu et al. 2020): a network on embeddings at voxel corners."""
