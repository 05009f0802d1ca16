"""Studies of one method: from what it declares in its `bench.study.Study`, not from its name."""
