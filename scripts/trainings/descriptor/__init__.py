"""GeoDesc: `scripts/train descriptor`."""
