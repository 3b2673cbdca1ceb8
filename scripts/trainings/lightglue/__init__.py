"""Parts of scripts/train lightglue.

sides         what the network sees of a picture, and pairs of such with their truth
homographies  stage 1: pictures warped and developed anew
blocks        stage 2: rendered blocks with parallax, occlusion and two suns
batches       pairs cut to equal numbers of keypoints
loss          of assignment and confidence
validation    recall at a precision, reliability, beside the ratio test
costs         seconds and memory, for scripts/bench_lightglue
"""
