"""Files of control points of other programs: one reader and one line of the table each."""

from aeromatch_cli.blocks.control_files.survey import Mark, Survey, SurveyedPoint
from aeromatch_cli.blocks.control_files.table import read_survey

__all__ = ["Mark", "Survey", "SurveyedPoint", "read_survey"]
