"""Errors for users. Apart from `bench.types`, so that the command line need not load torch."""


class SteerbenchError(Exception):
    """An error a user can act on: the message names what was expected, what came, what to do.

    The command line prints the message alone, without a traceback, and exits with status 2.
    """


class Unavailable(SteerbenchError):
    """Something asked for by name cannot be used here; the message says why and how to get it."""
