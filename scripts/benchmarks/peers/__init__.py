"""Methods that are compared: peers, and this project's presets with settings in brackets.

base      what a method is given and what it answers; pictures and weights of peers
matching  nearest neighbours, as users of OpenCV and kornia call them, and the presets' verification
opencv, colmap, aliked, kornia_peers, superpoint   the peers; published: some of them with a published LightGlue
ground    any peer on rectified views
ours      a preset of this project
table     name -> method
worker    one method on one scene in a process of its own; its answers on disk
command   `bench peers`
"""
