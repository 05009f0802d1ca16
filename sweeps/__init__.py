"""Hydra configurations and the `steerbench` command line."""
