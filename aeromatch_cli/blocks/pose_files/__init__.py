"""Pose files of other programs: one reader and one line of the table each.

Rotations and conventions are those of each program's own description, named in the reader's docstring.
"""

from aeromatch_cli.blocks.pose_files.table import AUTO, POSE_FORMATS, read_pose_file

__all__ = ["AUTO", "POSE_FORMATS", "read_pose_file"]
