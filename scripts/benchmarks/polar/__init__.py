"""`bench polar`: pairs of known and unknown parameters, and the SIFT side of every comparison.

command  options, and what is run
grounds  pictures of flat ground, and pairs cut out of them
blocks   pairs of real and of rendered blocks
sides    polar and SIFT on a pair
rows, tables
"""
