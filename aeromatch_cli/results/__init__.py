"""What stages report: one type per stage, from which come its JSON, the schema of `--json` and docs/workspace.md."""
