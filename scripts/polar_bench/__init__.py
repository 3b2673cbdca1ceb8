"""What scripts/bench_polar measures: pairs of known and unknown parameters, and the SIFT side of every comparison."""
