"""`bench blocks`: whole blocks with reference poses.

command  options, sections, and what is run
steps    one step (a preset, COLMAP's SIFT, its matching, its mapping) in a process of its own
series   the two series of a block, and its pairs across them
cases    the answer of one method on one block, kept: what does not change is not made again
counts   verified matches of an answer against reference poses
tables   rows as Markdown
"""
