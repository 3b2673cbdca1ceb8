"""`bench keypoints`: keypoints, their angles and their descriptors, by exact truth.

command        options, and what is run
pictures       stored images and ground views, with places in stored pixels
correspondence which keypoints of two pictures are one place, at one size, and how the picture turns there
detectors, orientations, descriptors   what is compared, by name, and its figures on a pair
metrics        figures of descriptors
figures        figures on disk
tables         rows as Markdown
"""
