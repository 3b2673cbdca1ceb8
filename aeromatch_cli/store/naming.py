"""Names of files in place of image ids, in all that leaves the program's own files: messages, failures.csv, JSON.

Ids name files of the workspace and are its keys; whoever reads a message knows the names in the folder of images.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from aeromatch_cli.formats.tables import read_images
from aeromatch_cli.workspace import Workspace


def names_on_file(workspace: Workspace) -> dict[str, str]:
    """Return image_id -> name, as the workspace has them; none before it knows its images."""
    return {image.image_id: image.name for image in read_images(workspace.images)} if workspace.images.is_file() else {}


def item_named(item: str, names: Mapping[str, str]) -> str:
    """Name what has failed as people know it: an image id by its name, "id0 id1" by both, anything else as it is."""
    ids = item.split(" ")  # ids have no spaces
    return " and ".join(names[i] for i in ids) if all(i in names for i in ids) else item


def with_names(value: Any, names: Mapping[str, str]) -> Any:
    """Return results of stages, as JSON, with names in place of all image ids, as keys and as values."""
    if isinstance(value, Mapping):
        return {names.get(key, key): with_names(item, names) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [with_names(item, names) for item in value]
    return names.get(value, value) if isinstance(value, str) else value
