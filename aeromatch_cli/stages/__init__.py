"""Stages: verbs that touch the disk. Each reads what earlier stages wrote, works on what is not up to date, and
writes one file per image row plus a report."""
