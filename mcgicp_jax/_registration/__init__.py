"""The registration of one pair of clouds: the loop, its executors, its options and its result."""
