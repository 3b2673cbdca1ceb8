"""One HTML page about a workspace: what is tied, what is not, and why; readable without network, printable.

rows -> figures -> map, previews -> page (page.html.jinja)
"""

from aeromatch_cli.report.page import is_of_earlier_results, page_if_up_to_date, run

__all__ = ["is_of_earlier_results", "page_if_up_to_date", "run"]
