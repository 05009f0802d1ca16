"""SteerNeRF (Li et al. 2022), in the order of Section 3 of the paper."""
