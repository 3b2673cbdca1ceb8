"""The result type of every stage. Images are named by their ids on file, and by their files' names in `--json`."""

from __future__ import annotations

from typing import ClassVar, Literal, NamedTuple

from pydantic import Field

from aeromatch_cli.results.adjustment import Control, GroupResult, PlacementKind, PoseResiduals
from aeromatch_cli.results.record import Record

# Images with fewer points that three images see are held by their neighbours one by one; pairs that share fewer tie no
# parts.
FEW_POINTS = 20
UNREAD = "Images whose pictures could not be read; the other lists, and the groups, are without them."


class StageResult(Record):
    """What one stage reports besides its counts and its time. stage: its name."""

    stage: ClassVar[str]


class MappedModel(Record):
    """A model that the mapper made of the first pass."""

    kind: PlacementKind
    images: int
    points: int
    track_length: float
    reprojection_error_px: float | None
    contradiction: str = Field(description="How the given positions contradict it, empty for not at all.")
    turned_back: list[str] = Field(
        description="Image ids of the images that a planar scene had turned to the wrong one of two poses."
    )


class FurtherFirstPass(Record):
    """A first pass that was tried after one with a poor result."""

    change: str = Field(description="What was different, in words.")
    images: int = Field(description="Images of the largest model before.")
    images_then: int = Field(description="Images of the largest model of this pass.")
    used: bool


class FocalChange(NamedTuple):
    """Focal lengths in pixels, as given and as found."""

    given_px: float
    found_px: float


class OrientResult(StageResult):
    """What the pictures say of the poses."""

    stage: ClassVar[str] = "orient"

    images_matched: int = Field(0, description="Images with verified matches in the first pass.")
    positions_given: int = 0
    given_poses_explained: int = Field(0, description="Images whose given poses explain their matches.")
    poses_from: Literal["given poses", "pictures"]
    stays: bool = Field(description="Whether given poses are kept because of orient=given.")
    frame: Literal["world", "own"] = Field(description="own: no position was given; metres mean nothing.")
    corrected: list[str] = Field([], description="Images whose given poses were replaced by resection.")
    models: list[MappedModel] = Field([], description="The mapper's models, the largest first.")
    by_one_pair: list[str] = Field([], description="Images oriented by their position and a single pair.")
    by_ground: list[str] = Field(
        [], description="Images oriented by a single pair and the height of the ground beside; none has a position."
    )
    calibrated: list[str] = Field([], description="Cameras whose focal length was found.")
    points: int = Field(description="Points that the terrain was made from.")
    wrong_attitudes: dict[str, float] = Field(description="Image -> degrees off.")
    wrong_positions: dict[str, float] = Field(description="Image -> metres off.")
    focal_lengths: dict[str, FocalChange] = Field(description="Camera -> focal lengths given and found, pixels.")
    outside: list[str] = Field(description="Images that could not be oriented.")
    remarks: list[str] = Field(description="What a person should know, a sentence each.")
    further_first_passes: list[FurtherFirstPass] = Field([], description="Tried as the first was poor.")
    stopped: str = Field("", description="Why the mapper stopped, empty where it did not.")


class BlockFigures(Record):
    """The block as it was read. Lengths are null where the scale is arbitrary; so is what is unknown."""

    images: int
    cameras: int
    positioned: int = Field(description="Images with a position.")
    oriented: int = Field(description="Images with an attitude.")
    crs: str
    metric: bool
    origin_m: tuple[float, float, float]
    ground_source: str
    flying_height_m: tuple[float | None, float | None, float | None] | None = Field(
        description="Lowest, median and highest above ground."
    )
    mean_tilt_deg: float | None
    max_tilt_deg: float | None
    gsd_m: float | None = Field(description="Ground sampling distance, median.")
    extent_m: tuple[float | None, float | None] | None = Field(description="East-west and north-south.")
    pairs: int | None
    pairs_by_reason: dict[str, int]
    best_overlap: float | None = Field(description="With the best neighbour, mean, 0 to 1.")
    unpaired: list[str] = Field(description="Names of images that are in no pair.")
    warnings: list[str]


class PairsResult(StageResult):
    """The block as it was read, and its pairs."""

    stage: ClassVar[str] = "pairs"

    images: int
    summary: list[str] = Field(description="What is printed of the block, line by line.")
    block: BlockFigures
    warnings: list[str] = Field(description="What a person should look at.")
    urgent: list[str] = Field([], description="Those of the warnings that --quiet does not hide.")
    unread: dict[str, str] = Field({}, description="Picture of a kind that is not read, or a copy -> reason.")
    left_out: list[str] = Field([], description="What `run --within` did without, so that it ended in time.")


class EnhanceResult(StageResult):
    """Which images were enhanced."""

    stage: ClassVar[str] = "enhance"

    images_skipped_same_illumination: int | None = Field(
        None, description="Images left as taken, as all images they are paired with were taken in the same light."
    )
    remark: str = ""


class ViewsResult(StageResult):
    """Views that were made of the images of this run."""

    stage: ClassVar[str] = "simulate"

    images: int = 0
    views: int = 0
    view_megapixels: float = 0.0

    @property
    def views_per_image(self) -> float:
        return self.views / max(self.images, 1)

    @property
    def megapixels_per_image(self) -> float:
        return self.view_megapixels / max(self.images, 1)


class ExtractResult(ViewsResult):
    """Features of the images of this run; with a cascade images, views and keypoints summed over the last runs of its
    steps, so that an image counts once for each step that made views of it."""

    stage: ClassVar[str] = "extract"

    keypoints: int | None = None
    images_without_keypoints: int = 0
    images_skipped_same_illumination: int | None = None
    images_by_step: dict[str, int] = Field({}, description="With a cascade: step -> images that it has looked at.")

    def plus(self, other: ExtractResult) -> ExtractResult:
        """The sums of both."""
        skipped = [self.images_skipped_same_illumination, other.images_skipped_same_illumination]
        known = [count for count in skipped if count is not None]
        return ExtractResult(
            images=self.images + other.images,
            views=self.views + other.views,
            view_megapixels=round(self.view_megapixels + other.view_megapixels, 6),
            keypoints=(self.keypoints or 0) + (other.keypoints or 0),
            images_without_keypoints=self.images_without_keypoints + other.images_without_keypoints,
            images_skipped_same_illumination=sum(known) if known else None,
        )


class MatchResult(StageResult):
    """Matches before verification."""

    stage: ClassVar[str] = "match"

    matches: int | None = Field(None, description="Before verification, of the pairs of this run.")
    settled_by: dict[str, int] = Field({}, description="With a cascade: step -> pairs that needed nothing after it.")
    not_settled: int | None = Field(None, description="With a cascade: pairs left with few matches, or gaps.")


class Connection(StageResult):
    """How verified matches connect the images."""

    verified_matches: int
    components: list[int] = Field([], description="Sizes of the groups of images that verified pairs connect.")
    weakly_tied: list[str] = Field([], description="Images with few verified matches.")
    unconnected: list[str] = Field([], description="Images with no verified match.")
    unread: list[str] = Field([], description=UNREAD)


class FilterResult(Connection):
    """The two-view verification."""

    stage: ClassVar[str] = "filter"

    pairs: dict[str, int] = Field(description="State (verified, rejected, not verifiable) -> pairs.")


class RefineResult(StageResult):
    """Tie points measured by least-squares matching."""

    stage: ClassVar[str] = "refine"

    keypoints: int | None = Field(None, description="Matched keypoints, without those that stand for their points.")
    measured: int | None = Field(None, description="Those of them that were measured.")
    shift_px: float | None = Field(None, description="By how much they were moved, median, pixels.")


class AdjustedCamera(NamedTuple):
    """A camera after the adjustment; parameters as in a camera file."""

    model: str
    width_px: int
    height_px: int
    parameters: list[float]


class AdjustResult(StageResult):
    """The bundle adjustment; without oriented images only `images`, `outside`, `stopped` and `remarks`."""

    stage: ClassVar[str] = "adjust"

    images: int = Field(description="Oriented images.")
    points: int = Field(0, description="Points in space.")
    track_length: float = Field(0.0, description="Images per point, mean.")
    held_by_pairs: int = Field(0, description="Images with fewer than 20 points that three images see.")
    tied_parts: list[int] = Field([], description="Sizes of parts within which pairs share 20 points.")
    reprojection_error_px: float | None = Field(None, description="Mean, pixels.")
    ground_pixel_m: float | None = Field(None, description="Size of a pixel on the ground, median.")
    sigma_position_m: float | None = Field(None, description="Of the positions, metres, median; null without metres.")
    sigma_angle_deg: float | None = Field(None, description="Of the attitudes, degrees, median.")
    groups: list[GroupResult] = Field([], description="Groups of images that hang together, the largest first.")
    cameras: dict[str, AdjustedCamera] = Field({}, description="Camera id -> camera.")
    positions_given: int = 0
    reduced: float = Field(1.0, description="Stored pixels in a pixel of the picture that keypoints were found in.")
    outside: dict[str, str] = Field({}, description="Images without adjusted pose -> reason.")
    stopped: str = Field("", description="Why the adjustment stopped, empty where it did not.")
    held_by: dict[str, str] = Field({}, description="Parameter of cameras -> setting that holds it.")
    guessed_cameras: list[str] = Field([], description="Cameras whose focal length was a guess at first.")
    readout_not_tried: str | None = Field(
        None, description="Why the read-out time of a rolling shutter was no unknown, null where it was."
    )
    control: Control | None = None
    remarks: list[str] = Field([], description="What a person should know, a sentence each.")
    residuals: PoseResiduals | None = Field(None, description="Adjusted less given poses; see residuals.csv.")


class Ninths(NamedTuple):
    """Of an image cut in 3 x 3 parts: how many hold a point, how many hold none though other images show them; and how
    many points of the image three or more images see."""

    held: int
    empty: int
    points: int


class ConsistencyResult(StageResult):
    """The final matches. Without an adjusted block, or a judgement of pairs, most is null."""

    stage: ClassVar[str] = "consistency"

    verified_matches: int | None = Field(None, description="Matches that are exported.")
    components: list[int] | None = Field(None, description="As of the stage filter, of the final matches.")
    weakly_tied: list[str] = Field([], description="Images with few final matches.")
    unconnected: list[str] = Field([], description="Images with no final match.")
    unread: list[str] = Field([], description=UNREAD)
    dropped_matches: int = Field(0, description="Matches that contradict the adjusted block or are unlikely.")
    contradicting_matches: int | None = Field(
        None, description="Those that contradict the adjusted block; the others are unlikely."
    )
    rejected_pairs: int = Field(0, description="Pairs all of whose matches were dropped.")
    expected_right: float | None = Field(None, description="Share (0-1) of the final ones that is right to 3 px.")
    doubtful: list[str] = Field([], description="Images that the block seems to hold in a wrong place.")
    points: int = Field(0, description="Points of the adjusted block.")
    points_left: int = Field(0, description="Those of them that the final matches hold.")
    observations: int = 0
    observations_left: int = 0
    reprojection_error_px: float | None = Field(None, description="Mean of the points that are left, pixels.")
    spread: dict[str, Ninths] = Field({}, description="Image -> where it holds points.")
    remark: str = ""


def with_final_points(adjust: AdjustResult, judged: ConsistencyResult | None) -> AdjustResult:
    """An adjusted block with the figures of those points alone that final matches hold. judged: of this block; those of
    earlier versions do not know the error, and change nothing."""
    if judged is None or judged.reprojection_error_px is None:
        return adjust
    held_by_pairs = sum(ninths.points < FEW_POINTS for ninths in judged.spread.values())
    return adjust.model_copy(
        update={
            "points": judged.points_left,
            "track_length": round(judged.observations_left / max(1, judged.points_left), 3),
            "reprojection_error_px": judged.reprojection_error_px,
            "held_by_pairs": held_by_pairs,
        }
    )


class Exported(Record):
    """What one exporter wrote."""

    name: str
    files: list[str] = Field(description="Relative to the exporter's folder.")
    images: int
    posed_images: int
    keypoints: int
    matched_pairs: int
    matches: int
    verified_pairs: int
    verified_matches: int
    remarks: list[str] = Field(description="What the format does not hold.")


class ExportResult(StageResult):
    """What the exporters wrote."""

    stage: ClassVar[str] = "export"

    exporters: dict[str, Exported]


class ReportResult(StageResult):
    """The report page."""

    stage: ClassVar[str] = "report"

    page: str
    bytes: int
    of_results: str = Field("", description="Fingerprint of all that the page tells of but the settings.")


class BlockResults(Record):
    """What the stages have found of a block; None where they have not run."""

    orient: OrientResult | None = None
    pairs: PairsResult | None = None
    filter: FilterResult | None = None
    refine: RefineResult | None = None
    adjust: AdjustResult | None = None
    consistency: ConsistencyResult | None = None

    @property
    def final_block(self) -> AdjustResult | None:
        """The adjusted block with the points that the final matches hold: what is exported, and judged."""
        return None if self.adjust is None else with_final_points(self.adjust, self.consistency)

    @property
    def connection(self) -> FilterResult | ConsistencyResult | None:
        """How the final matches connect the images."""
        judged = self.consistency
        return judged if judged is not None and judged.components is not None else self.filter
