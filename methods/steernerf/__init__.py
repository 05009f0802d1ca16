"""SteerNeRF (Li et al. 2022): pipeline, buffer and unet render; patches and stage2 train them."""
