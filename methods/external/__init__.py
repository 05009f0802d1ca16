"""A renderer in another process, as a method: docs/external.md has the protocol."""
