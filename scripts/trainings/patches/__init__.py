"""Parts of scripts/train descriptor and scripts/train orientation.

sights      pictures of a place, as taken and north-up, and where ground points lie in them
tracks      patches of one ground point in several pictures, cut with a margin
sources     where tracks come from: rendered blocks, homographies, reference reconstructions
data        tracks on disk
draws       patches as a step of training sees them: jittered, turned, developed anew
loss        of descriptors
validation  FPR95 and mean average precision, beside other descriptors
turns       errors of orientations, beside other estimators
runs        what both recipes share: recipe, state, learning rate, curves
"""
