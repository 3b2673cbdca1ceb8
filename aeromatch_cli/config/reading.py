"""Configuration files: text, and YAML in which no key is written twice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.reading import given_bytes


def read_text(path: Path) -> str:
    """The text of a file. Raises ConfigError where it cannot be read or is not UTF-8."""
    try:
        return given_bytes(path).decode("utf-8-sig")
    except OSError as error:
        raise ConfigError(f"cannot read configuration {path}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise ConfigError(f"configuration {path} is not UTF-8 text: save it as UTF-8") from None


class UniqueKeyLoader(yaml.SafeLoader):
    """Refuses a key that is written twice; YAML would silently take the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if isinstance(key_node, yaml.ScalarNode):
                if key_node.value in seen:
                    raise yaml.MarkedYAMLError(
                        problem=f"the key {key_node.value!r} is written twice", problem_mark=key_node.start_mark
                    )
                seen.add(key_node.value)
        return super().construct_mapping(node, deep)
