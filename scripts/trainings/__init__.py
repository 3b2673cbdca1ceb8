"""What `scripts/train NAME` runs. `__main__` has the table of names; what several trainings use stands beside it."""
