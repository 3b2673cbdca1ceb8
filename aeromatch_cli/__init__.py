"""aeromatch: verified, evenly spread tie points for aerial image blocks."""

import time

__version__ = "0.1.0"

# When the package was loaded, on the clock of time.monotonic(): a process of the command line has hardly begun by then.
LOADED_S = time.monotonic()

# The preset of commands and settings files that name none.
DEFAULT_PRESET = "auto"
