"""`bench blocks`: whole blocks with reference poses.

command  options, sections, and what is run
steps    one step (a preset, COLMAP's SIFT, its matching) in a process of its own
cases    the answer of one method on one block, kept, and its verified matches against reference poses
tables   rows as Markdown
"""
