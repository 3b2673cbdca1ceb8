"""The orientation network: `scripts/train orientation`."""
