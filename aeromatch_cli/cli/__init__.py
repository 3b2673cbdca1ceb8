"""The command line: parse, one call, print. Results go to stdout, messages to stderr, errors become exit codes.

0 all done; 1 finished, but some items failed (listed); 2 bad arguments or configuration; 3 nothing usable;
130 interrupted (run the same command again: it resumes).
"""

from aeromatch_cli.cli.app import app, main, weights_app

__all__ = ["app", "main", "weights_app"]
