"""Settings: the schema, presets and files, `--set` overrides, messages on faults, and the commented default file."""

from aeromatch_cli.config.load import dump, load, parse_method, plain, preset_names, validate
from aeromatch_cli.config.merge import differing
from aeromatch_cli.config.paths import PATH_KEYS
from aeromatch_cli.config.schema import FAMILIES, BlockSettings, RunSettings, Settings

__all__ = [
    "FAMILIES",
    "PATH_KEYS",
    "BlockSettings",
    "RunSettings",
    "Settings",
    "differing",
    "dump",
    "load",
    "parse_method",
    "plain",
    "preset_names",
    "validate",
]
