"""Parts of scripts/train detector.

shapes      stage 1: simple shapes with exact corners
groups      stage 2: views of one place with their warps, of real pictures and of rendered blocks
scenes      rendered blocks as the detector sees them: ground views with the depth of every pixel
loss        labels by adaptation, and what makes heat repeatable between two views
validation  repeatability on unseen rendered pairs, beside SIFT
"""
