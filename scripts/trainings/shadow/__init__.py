"""The shadow network: `scripts/train shadow`."""
