"""aeromatch: verified, evenly spread tie points for aerial image blocks."""

__version__ = "0.1.0"

# The preset of commands and settings files that name none.
DEFAULT_PRESET = "auto"
