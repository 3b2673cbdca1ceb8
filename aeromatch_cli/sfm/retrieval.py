"""Image retrieval finds which images of a block look alike, from their own descriptors.

Source: pycolmap's visual index, a vocabulary of the block's descriptors with inverted lists and Hamming embedding
(Schoenberger et al. 2016, A vote-and-verify strategy for fast spatial verification in image retrieval). The vocabulary
grows with the block, so that the lists of its words, and with them the time of a query, stay as long as they are.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from aeromatch_cli.data import FloatArray, IntArray
from aeromatch_cli.formats.archives import load_arrays
from aeromatch_cli.sfm.process import quiet_pycolmap, run_process

# Visual words per image, and the limits of their number.
_WORDS_PER_IMAGE, _FEWEST_WORDS, _MOST_WORDS = 20, 500, 30_000
# Descriptors that the vocabulary is made from, per word.
_TRAINED_PER_WORD = 50
# Longest ranking: an image has hardly more others that overlap it and are not found from their side.
_RANKED_PER_CANDIDATE = 3


def similar_pairs(features: Mapping[str, Path], candidates: int) -> list[tuple[str, str]]:
    """Return pairs (image_id0, image_id1) of images that look alike, `candidates` per image, sorted.

    features: image_id -> file with byte descriptors; images without one have no pairs. Raises InputError where
    pycolmap stops.
    """
    ids = sorted(image_id for image_id, path in features.items() if path.is_file())
    if len(ids) < 2:
        return []
    with tempfile.TemporaryDirectory(prefix="aeromatch-") as scratch:
        folder = Path(scratch)
        task = {"features": [str(features[i]) for i in ids], "ranked": _RANKED_PER_CANDIDATE * candidates}
        (folder / "task.json").write_text(json.dumps(task), encoding="utf-8")
        ranking = np.load(run_process("retrieval", folder, "ranking.npy", "pycolmap's image retrieval"))
    return sorted((ids[a], ids[b]) for a, b in best_pairs(ranking, candidates * len(ids)))


def best_pairs(ranking: IntArray, count: int) -> set[tuple[int, int]]:
    """Return the first `count` pairs (a < b) of a ranking (N, R): all first choices, then all second ones, and so on.

    ranking: row by row the other images by falling similarity, -1 where there is none.
    """
    pairs: set[tuple[int, int]] = set()
    for column in ranking.T:
        for own, other in enumerate(column):
            if len(pairs) >= count:
                return pairs
            if other >= 0 and other != own:
                pairs.add((min(own, int(other)), max(own, int(other))))
    return pairs


def _retrieve(folder: Path) -> None:
    """The child's part: ranking.npy (N, R) from task.json. A process of its own, as in `mapping`."""
    pycolmap = quiet_pycolmap()
    task = json.loads((folder / "task.json").read_text(encoding="utf-8"))
    descriptors = _write_database(pycolmap, folder / "retrieval.db", [Path(path) for path in task["features"]])
    images = len(task["features"])
    words = int(np.clip(_WORDS_PER_IMAGE * images, _FEWEST_WORDS, _MOST_WORDS))
    rng = np.random.default_rng(0)
    chosen = np.sort(rng.choice(len(descriptors), min(len(descriptors), _TRAINED_PER_WORD * words), replace=False))
    options = pycolmap.VisualIndex.BuildOptions()
    options.num_visual_words, options.num_threads = min(words, len(chosen)), 1
    options.num_iterations, options.num_rounds = 3, 1
    index = pycolmap.VisualIndex.create(128, 64)
    index.build(options, _floats(pycolmap, descriptors[chosen]))
    index.write(folder / "vocabulary.bin")
    pairing = pycolmap.VocabTreePairingOptions()
    pairing.vocab_tree_path = folder / "vocabulary.bin"
    pairing.num_images, pairing.num_nearest_neighbors = min(images, task["ranked"] + 1), 1
    pairing.num_threads = 1
    with pycolmap.Database.open(folder / "retrieval.db") as database:
        generator = pycolmap.VocabTreePairGenerator(pairing, database)
        ranking = np.full((images, task["ranked"]), -1)
        while not generator.has_finished():
            found = [(a - 1, b - 1) for a, b in generator.next() if a != b]
            for column, (own, other) in enumerate(found[: task["ranked"]]):
                ranking[own, column] = other
    np.save(folder / "ranking.npy", ranking)


def _write_database(pycolmap: ModuleType, path: Path, features: list[Path]) -> FloatArray:
    """A database of keypoints and descriptors alone; returns all descriptors (M, 128)."""
    everything = []
    with pycolmap.Database.open(path) as database:
        database.write_camera(pycolmap.Camera(model="SIMPLE_PINHOLE", params=[1, 0, 0], camera_id=1), True)
        for number, file in enumerate(features, start=1):
            arrays = load_arrays(file, ("keypoints_px", "descriptors", "descriptor_keypoint_idx"))
            points = arrays["keypoints_px"][arrays["descriptor_keypoint_idx"]].astype(np.float32).reshape(-1, 2)
            database.write_image(pycolmap.Image(name=str(number), camera_id=1, image_id=number), True)
            database.write_keypoints(
                number, np.column_stack([points, np.ones((len(points), 1)), np.zeros(len(points))])
            )
            database.write_descriptors(number, _bytes(pycolmap, arrays["descriptors"]))
            everything.append(arrays["descriptors"])
    return np.concatenate(everything)


def _bytes(pycolmap: ModuleType, descriptors: FloatArray) -> Any:
    return pycolmap.FeatureDescriptors(type=pycolmap.FeatureExtractorType.SIFT, data=descriptors)


def _floats(pycolmap: ModuleType, descriptors: FloatArray) -> Any:
    data = descriptors.astype(np.float32)
    return pycolmap.FeatureDescriptorsFloat(type=pycolmap.FeatureExtractorType.SIFT, data=data)


if __name__ == "__main__":
    _retrieve(Path(sys.argv[1]))
