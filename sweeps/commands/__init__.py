"""The commands of `steerbench`; commands.toml declares their arguments."""
