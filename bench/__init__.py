"""The benchmark: scenes, metrics, clocks, protocols and the store of results. Names no method."""
