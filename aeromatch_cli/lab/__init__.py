"""The laboratory: what measures the product and is no part of it.

    synthetic            rendered blocks with exact truth
    rendered, surfaces   matches judged by that truth; `open_truth` opens it, or reference poses
    strategies           arms of comparisons: strategies that a preset is measured against, and no preset uses

The product never imports it (an import contract): the commands `synth` and `evaluate` load it when they are called, the
benchmarks, trainings and tests whenever they like. Rays through rendered scenes need embreex, the extra `lab`.
"""
