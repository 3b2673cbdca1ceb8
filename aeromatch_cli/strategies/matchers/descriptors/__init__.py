"""Matchers that compare descriptors: nearest neighbours, the ratio test from both images, and guided search."""
