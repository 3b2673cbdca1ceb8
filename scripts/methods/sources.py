"""What answers depend on: source files and libraries, so that a stored answer is never taken for another's."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

import aeromatch_cli
from aeromatch_cli.workspace import file_digest, fingerprint

_PEERS = ("aliked", "base", "colmap", "keynet", "matching", "opencv_asift", "opencv_sift", "superpoint", "worker")
# Source that answers depend on, below the package or scripts. Peers read no more of the package than lens models.
PEER_CODE = ("geometry/cameras.py", "geometry/frames.py", *(f"methods/{module}.py" for module in _PEERS))
OUR_CODE = (
    "blocks",
    "geometry",
    "nets",
    "stages",
    "strategies",
    "data.py",
    "formats",
    "images",
    "methods/ours.py",
)
# Peers on rectified views read what makes these, too.
GROUND_CODE = (
    *PEER_CODE,
    "blocks",
    "geometry",
    "stages",
    "strategies/simulators",
    "strategies/pairings",
    "data.py",
    "images",
    "methods/ground.py",
)
LIBRARIES = ("opencv-python-headless", "torch", "kornia", "pycolmap", "poselib", "numpy")


def code_digest(*places: str) -> str:
    """Digest of source files and folders below the package or scripts."""
    roots = [Path(aeromatch_cli.__file__).parent, Path(__file__).parent.parent]
    paths = [root / place for root in roots for place in places]
    files = [file for path in paths for file in _files(path)]
    return fingerprint([(path.name, file_digest(path)) for path in files])


def _files(path: Path) -> Iterable[Path]:
    """Modules, and weights that ship beside them."""
    return [path] if path.is_file() else sorted(f for f in path.rglob("*") if f.suffix in (".py", ".safetensors"))


def versions() -> list[str]:
    """Of the libraries that matter, in the order of LIBRARIES."""
    return [metadata.version(library) for library in LIBRARIES]
