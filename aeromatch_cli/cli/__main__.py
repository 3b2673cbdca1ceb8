"""`python -m aeromatch_cli.cli` is the command `aeromatch`."""

from aeromatch_cli.cli import main

main()
