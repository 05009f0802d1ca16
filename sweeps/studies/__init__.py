"""Studies of one method, driven by its declared `bench.study.Study`, not by its name."""
