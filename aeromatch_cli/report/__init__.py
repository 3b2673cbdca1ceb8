"""One HTML page about a workspace: what is tied, what is not, and why; readable without network, printable.

rows -> figures -> map, previews -> page (page.html.jinja)
"""

from aeromatch_cli.report.page import run, told_digests

__all__ = ["run", "told_digests"]
