"""Operations that this method alone computes; see `methods.kernels`."""
