"""SteerNeRF (Li et al. 2022), after Section 3 of the paper; `beyond` holds our extensions."""
