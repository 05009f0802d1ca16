"""The commands of `steerbench`, a file each; sweeps/arguments.py declares their arguments."""
