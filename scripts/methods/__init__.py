"""The methods that scripts/bench_methods compares: peers, one file each, and this project's presets.

base      what a method is given and what it answers
matching  nearest neighbours and MAGSAC++, as users of OpenCV and kornia call them
opencv_sift, opencv_asift, colmap, aliked, keynet   the peers
ours      a preset of this project, with settings in brackets
table     name -> method
scenes    rendered scenes and real blocks, and which of their pairs are judged
worker    one method on one scene in a process of its own, timed
sources   source files and libraries that answers depend on
store     what methods answered, on disk
results   rows, their file, and the tables made from it
goals, goal_tables   every method against SIFT + ratio and against unprocessed images
view_costs   what views of an image cost, for scripts/bench_views
"""
