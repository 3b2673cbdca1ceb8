"""Pairs of photographs with truth that others have measured."""
