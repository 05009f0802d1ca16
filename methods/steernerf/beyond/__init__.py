"""What the paper does not have: a lean 2D renderer, the field at the surface, refinement."""
