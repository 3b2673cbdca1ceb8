"""Orientation from the pictures, where what was given is wrong or missing."""
