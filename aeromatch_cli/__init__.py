"""aeromatch: verified, evenly spread tie points for aerial image blocks."""

__version__ = "0.1.0"
