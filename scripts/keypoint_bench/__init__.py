"""What bench_detector and bench_descriptors are made of.

pictures -> detectors, orientations, descriptors     what is compared, on source images and on ground views
correspondence, metrics                              truth of keypoints, figures
blocks -> rows, tables
"""
