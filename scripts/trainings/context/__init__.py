"""Parts of `scripts/train context`."""
