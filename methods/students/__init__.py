"""Shared by the methods whose model starts from a trained Instant-NGP field."""
