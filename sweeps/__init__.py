"""What is varied: Hydra configurations and the `steerbench` command line."""
