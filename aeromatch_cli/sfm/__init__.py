"""Terrain and attitudes from matches: arrays in, arrays out."""
