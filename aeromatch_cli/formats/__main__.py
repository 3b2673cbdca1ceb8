"""docs/workspace.md, made from the specification.

To bring the page up to date: `python -m aeromatch_cli.formats > docs/workspace.md`.
"""

import sys

from aeromatch_cli import formats

sys.stdout.write(formats.page())
