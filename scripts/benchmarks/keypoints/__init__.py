"""`bench keypoints`: keypoints, their angles and their descriptors, by exact truth.

command        options, and what is run
correspondence pictures, and which keypoints of two of them are one place, at one size, and how the picture turns there
detectors, orientations, descriptors   what is compared, by name, and its figures on a pair
figures        names, and figures on disk
tables         rows as Markdown
"""
