"""`bench claims`: the claims of the three papers' abstracts beside this project, and ablations of single steps.

command    options, what is run in which order, the page
work       units of work: rows on file, two processes
intervals  estimates over pairs with bootstrap intervals, and the verdict on a claim
shadow, registration, features   the claims of papers A, B and C, and the ablations on the same pairs
grounds    flat ground with detail at full size, and pairs cut out of it by a known similarity
sides      polar and SIFT on a pair of pictures
"""
