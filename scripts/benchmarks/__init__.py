"""What `scripts/bench NAME` runs. `__main__` has the table of names; what several benchmarks use stands beside it."""
