"""What methods share whose model starts from a trained Instant-NGP field, their teacher."""
