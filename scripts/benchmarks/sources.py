"""What answers depend on: source files and libraries, so that a stored answer is never taken for another's."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

import aeromatch_cli
from aeromatch_cli.fingerprints import file_digest, fingerprint

# Source that answers depend on, below the package or scripts. Peers read no more of the package than lens models.
PEER_CODE = (
    "geometry/cameras.py", "geometry/frames.py", "nets/aliked.py", "benchmarks/processes.py",
    *(
        f"benchmarks/peers/{name}.py"
        for name in (
            "aliked", "base", "colmap", "kornia_peers", "matching", "opencv", "published", "superpoint", "union",
        )
    ),
)  # fmt: skip
OUR_CODE = (
    "blocks", "geometry", "nets", "sfm", "stages", "strategies", "data.py", "formats", "images",
    "lab/strategies", "benchmarks/peers/ours.py",
)  # fmt: skip
# Peers on rectified views read what makes these, too.
GROUND_CODE = (
    *PEER_CODE, "blocks", "geometry", "stages", "strategies/simulators", "strategies/pairings", "data.py", "images",
    "benchmarks/views.py",
)  # fmt: skip
LIBRARIES = ("opencv-python-headless", "torch", "kornia", "pycolmap", "poselib", "numpy")
_ROOTS = Path(aeromatch_cli.__file__).parent, Path(__file__).parent.parent


def code_digest(*places: str) -> str:
    """Digest of modules, and of weights that ship beside them, below the package or scripts."""
    return fingerprint([(path.name, file_digest(path)) for place in places for path in _files(place)])


def _files(place: str) -> list[Path]:
    path = next(root / place for root in _ROOTS if (root / place).exists())
    return [path] if path.is_file() else sorted(f for f in path.rglob("*") if f.suffix in (".py", ".safetensors"))


def library_versions() -> list[str]:
    """Of the libraries that matter, in the order of LIBRARIES."""
    return [metadata.version(library) for library in LIBRARIES]
