"""Whether two workspaces hold the same verified matches, array by array.

Compared are, of every pair: indices, points of both images (stored pixels), scores, errors, standard deviations, state,
model and relative rotation, and how many matches entered the filters. Fingerprints, reasons and the names of filters
are left out: they hold words, which may change where no result does. Prints pairs, matches and one SHA-256 over all
arrays of each workspace. Exit code 0: the same; 1: different; 2: a folder is no workspace with verified matches.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Arrays of verified/<id0>.npz: a row for each match, and for each pair.
OF_MATCHES = ("indices", "scores", "errors_px", "sigmas_px")
OF_PAIRS = ("state", "model_kind", "models", "rotations", "matches_in")
NAMED = 10  # pairs that differ are named up to so many
Pair = tuple[str, str]
Digests = Mapping[str, str]


def read_pairs(workspace: Path) -> Iterator[tuple[Pair, dict[str, NDArray[Any]]]]:
    """Image ids of every verified pair and its arrays; files are read without the package, of whatever age they are.

    Raises FileNotFoundError where there are none.
    """
    rows = sorted((workspace / "verified").glob("*.npz"))
    if not rows:
        raise FileNotFoundError(f"{workspace} has no verified matches (verified/*.npz)")
    keypoints: dict[str, NDArray[Any]] = {}
    for path in rows:
        with np.load(path, allow_pickle=False) as archive:
            row = {name: archive[name] for name in archive.files}
        for p, image_id1 in enumerate(row["image_id1"].tolist()):
            span = slice(int(row["offsets"][p]), int(row["offsets"][p + 1]))
            found = {name: row[name][span] for name in OF_MATCHES if name in row}
            found |= {name: row[name][p : p + 1] for name in OF_PAIRS}
            for side, image_id in enumerate((path.stem, image_id1)):
                if image_id not in keypoints:
                    keypoints[image_id] = read_keypoints(workspace, image_id)
                measured = row[f"points{side}_px"][span] if f"points{side}_px" in row else None
                found[f"points{side}_px"] = points_of(found["indices"][:, side], keypoints[image_id], measured)
            yield (path.stem, image_id1), found


def read_keypoints(workspace: Path, image_id: str) -> NDArray[Any]:
    """(K, 2) stored pixels, none without a file."""
    path = workspace / "features" / f"{image_id}.npz"
    if not path.is_file():
        return np.zeros((0, 2), np.float32)
    with np.load(path, allow_pickle=False) as archive:
        return np.asarray(archive["keypoints_px"])


def points_of(indices: NDArray[Any], keypoints: NDArray[Any], measured: NDArray[Any] | None) -> NDArray[Any]:
    """(M, 2) float64: keypoints by index, measured points where the index is -1, NaN where neither is known."""
    points = np.full((len(indices), 2), np.nan) if measured is None else measured.astype(np.float64)
    known = (indices >= 0) & (indices < len(keypoints))
    points[known] = keypoints[indices[known]]
    return points


def digests(workspace: Path) -> tuple[dict[Pair, Digests], int, str]:
    """Array name -> SHA-256 of every pair, the number of matches, and one SHA-256 over everything."""
    found: dict[Pair, Digests] = {}
    matches = 0
    for pair, arrays in read_pairs(workspace):
        found[pair] = {name: array_digest(array) for name, array in arrays.items()}
        matches += len(arrays["indices"])
    whole = hashlib.sha256()
    for pair in sorted(found):
        whole.update(repr((pair, sorted(found[pair].items()))).encode())
    return found, matches, whole.hexdigest()


def array_digest(array: NDArray[Any]) -> str:
    """SHA-256 of an array's shape, type and values; text by what it says, whatever width it is stored in."""
    if array.dtype.kind == "U":
        return hashlib.sha256(repr(array.tolist()).encode()).hexdigest()
    head = f"{array.dtype.str} {array.shape} ".encode()
    return hashlib.sha256(head + np.ascontiguousarray(array).tobytes()).hexdigest()


def differences(first: Mapping[Pair, Digests], second: Mapping[Pair, Digests]) -> list[str]:
    """A line for every pair that is not the same in both."""
    lines = []
    for pair in sorted(first.keys() | second.keys()):
        one, other = first.get(pair), second.get(pair)
        if one is None or other is None:
            lines.append(f"{' '.join(pair)}: only in the {'second' if one is None else 'first'}")
        elif one != other:
            names = sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name))
            lines.append(f"{' '.join(pair)}: {', '.join(names)}")
    return lines


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="scripts/bench same", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("workspaces", type=Path, nargs=2, metavar="WORK")
    args = parser.parse_args(arguments)
    found = []
    for workspace in args.workspaces:
        try:
            pairs, matches, whole = digests(workspace)
        except FileNotFoundError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        print(f"{workspace}: {len(pairs)} pairs, {matches} matches, SHA-256 {whole}")
        found.append(pairs)
    lines = differences(*found)
    if not lines:
        print("the same")
        return 0
    print(f"{len(lines)} pairs differ:")
    print("\n".join(f"  {line}" for line in lines[:NAMED] + ["..."] * (len(lines) > NAMED)))
    return 1
