"""Volume rendering of a field: to train, all samples at once; to render, a few at a time."""
