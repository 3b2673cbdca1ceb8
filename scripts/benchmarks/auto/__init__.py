"""`bench auto`: whether one command without a preset's name gives at least what the best preset gives.

command     the sections and their options
blocks      rendered blocks by condition, with exact truth
runs        one method on one block: rows of its pairs, kept on disk
rendered    presets and peers, by condition
strategies  auto with one strategy more, or another one, and whether it belongs into auto
real        thinned real blocks: images in the block's own model beside pycolmap's mappers
"""
