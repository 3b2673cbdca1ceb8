"""`bench methods`: presets beside peers on pairs that truth judges.

command      options, and what is run
worker       one method on one scene in a process of its own; its answers on disk
results      rows, and the tables made from them
goals, oblique   every method against SIFT + ratio, unprocessed images, and peers above 40 degrees
"""
