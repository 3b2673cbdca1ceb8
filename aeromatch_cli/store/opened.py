"""The block of a workspace, for commands that look at it: show, compare and evaluate."""

from __future__ import annotations

from functools import cached_property, lru_cache
from pathlib import Path

from aeromatch_cli.config import Settings, load
from aeromatch_cli.data import AdjustedBlock, Camera, FloatArray, Image, Pair, Pose
from aeromatch_cli.formats.adjusted import read_adjusted
from aeromatch_cli.formats.features import read_final_keypoints
from aeromatch_cli.formats.rows import MatchEntry, VerifiedEntry, read_match_row, read_verified_row
from aeromatch_cli.formats.tables import read_cameras, read_images, read_pairs, read_poses
from aeromatch_cli.images.remote import is_remote, on_disk, remote_file
from aeromatch_cli.store.block_store import BlockStore, stale_image
from aeromatch_cli.store.index import Index
from aeromatch_cli.store.matches import FinalEntries, check_features
from aeromatch_cli.workspace import opened_workspace

# Rows, and images whose keypoints are at hand: pairs follow each other in the order of their first images.
_ROWS_KEPT, _IMAGES_KEPT = 4, 1024


class OpenedBlock:
    """Tables, keypoints and final matches of a workspace, each read once. Raises as `opened_workspace`."""

    def __init__(self, root: Path) -> None:
        self.workspace = workspace = opened_workspace(root)
        self.store = BlockStore(workspace, Index(workspace.index, read_only=True))
        self._verified_row = lru_cache(_ROWS_KEPT)(lambda image_id: read_verified_row(workspace.verified(image_id)))
        self._match_row = lru_cache(_ROWS_KEPT)(lambda image_id: read_match_row(workspace.matches(image_id)))
        self._keypoints_px = lru_cache(_IMAGES_KEPT)(
            lambda i: read_final_keypoints(workspace.features(i), workspace.refined(i))
        )

    @cached_property
    def images(self) -> dict[str, Image]:
        """Return the images by image_id."""
        return {image.image_id: image for image in read_images(self.workspace.images)}

    @cached_property
    def names(self) -> dict[str, str]:
        """Return the names of the images by image_id."""
        return {image_id: image.name for image_id, image in self.images.items()}

    @cached_property
    def poses(self) -> dict[str, Pose]:
        return read_poses(self.workspace.poses)

    @cached_property
    def cameras(self) -> dict[str, Camera]:
        return read_cameras(self.workspace.cameras)

    @cached_property
    def pairs(self) -> list[Pair]:
        """Return the pairs on the list, in its order; what an older list left behind does not count."""
        return read_pairs(self.workspace.pairs) if self.workspace.pairs.is_file() else []

    @cached_property
    def adjusted(self) -> AdjustedBlock | None:
        """Return the block of the last adjustment."""
        return read_adjusted(self.workspace.adjusted) if self.workspace.adjusted.is_file() else None

    @cached_property
    def settings(self) -> Settings:
        """Return the settings of the last run, in this folder."""
        found = load(str(self.workspace.config))
        return found.model_copy(update={"workspace": str(self.workspace.root)})

    def picture(self, image: Image) -> Path:
        """Return the file of an image."""
        folder = self.settings.block.images
        return on_disk(remote_file(folder, image.name)) if is_remote(folder) else Path(folder) / image.name

    def keypoints_px(self, image_id: str) -> FloatArray:
        """Return the keypoints (K, 2) of an image, stored pixels, where they were measured last; none of an image
        without features."""
        return self._keypoints_px(image_id)

    def matches(self, pair: Pair) -> MatchEntry | None:
        """Return the matches of a pair before verification. Raises WorkspaceError where they are of other features."""
        found = self._match_row(pair.image_id0).get(pair.image_id1)
        if found is not None:
            check_features(self.workspace, pair.image_id0, found, self.store.features_fingerprint)
        return found

    def final(self, pair: Pair) -> VerifiedEntry | None:
        """Return the final matches of a pair. Raises WorkspaceError where they are of other features."""
        found = self._verified_row(pair.image_id0).get(pair.image_id1)
        if found is None:
            return None
        check_features(self.workspace, pair.image_id0, found, self.store.features_fingerprint)
        return self._final.left(pair.image_id0, found)

    def stale(self, pair: Pair) -> str:
        """Return the image of a pair whose features were made again after it was matched, "" where there is none."""
        known = self.store.verdicts(pair.image_id0).get(pair.image_id1)
        ids = pair.image_id0, pair.image_id1
        return "" if known is None else stale_image(ids, known.features, self.store.features_fingerprint)

    @cached_property
    def _final(self) -> FinalEntries:
        return FinalEntries(self.workspace)
