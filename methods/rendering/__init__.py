"""Volume rendering of a field: all samples at once in training, a few at a time for frames."""
