"""The benchmark: scenes, metrics, probes, protocols and the store of results. Names no method."""
