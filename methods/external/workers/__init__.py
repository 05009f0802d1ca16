"""Workers that come with steerbench: programs, run in the environment of what they render with."""
