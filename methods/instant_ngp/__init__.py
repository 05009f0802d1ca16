"""Instant-NGP (Müller et al. 2022): a hash-grid field, its training, its rendering."""
