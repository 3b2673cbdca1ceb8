"""What the stage adjust reports of the bundle adjustment."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, NamedTuple

from pydantic import Field

from aeromatch_cli.results.record import Record

Xyz = tuple[float, float, float]
PlacementKind = Literal["given", "positions", "level"]


def xyz(values: Iterable[float]) -> Xyz:
    """Three values as they are stated, of an array (3,)."""
    x, y, z = map(float, values)
    return x, y, z


class Estimate(NamedTuple):
    """An unknown of the adjustment: its value and its standard deviation."""

    value: float
    sigma: float


class Parameter(NamedTuple):
    """A parameter of a camera: its value, its standard deviation (0 where it was held), the value that was known before
    and the standard deviation of that."""

    value: float
    sigma: float
    prior: float
    prior_sigma: float


class FlightOffset(Record):
    """By how much the given positions of one flight differ from the adjusted ones."""

    flight: str = Field(description="Name of the flight, empty for images that belong to none.")
    images: int
    mean_m: Xyz = Field(description="Mean difference along x, y and z, metres.")
    scatter_m: Xyz = Field(description="Standard deviation of the differences, metres.")


class PositionResiduals(Record):
    """How the given positions of a group agree with the adjusted block."""

    images: int = Field(description="Images that have a position.")
    used: int = Field(description="Images whose position took part in the adjustment.")
    wrong: list[str] = Field(description="Image ids whose positions contradict the others and were not used.")
    rms_m: Xyz | None = Field(
        description="Root mean square of measured less adjusted positions along x, y and z, metres, after what was "
        "found of flights and antennas; null where no position was used."
    )
    rms_sigmas: Xyz | None = Field(description="The same in stated standard deviations.")
    stated_m: Xyz = Field(description="Medians of the stated standard deviations, metres.")
    factors: tuple[float, float] = Field(
        description="By how much positions are less exact than stated, horizontally and vertically."
    )
    flights: list[FlightOffset]


class FlightCorrection(Record):
    """What was found of the positions of one flight. Unknowns that the flight does not have are null."""

    flight: str = Field(description="Name of the flight, empty for images that belong to none.")
    images: int
    step_m: float = Field(
        description="Height of its positions above those of the largest flight, metres; taken out beforehand."
    )
    shift_x: Estimate | None = Field(None, description="Shift of the positions, metres.")
    shift_y: Estimate | None = None
    shift_z: Estimate | None = None
    lag_s: Estimate | None = Field(None, description="By how much positions lag behind the exposures, seconds.")
    slope_x: Estimate | None = Field(None, description="Rise of the heights of positions to the east, m per m.")
    slope_y: Estimate | None = Field(None, description="Rise of the heights of positions to the north, m per m.")

    @property
    def shifts(self) -> tuple[Estimate, Estimate, Estimate]:
        """Shifts along x, y and z, zero where they were no unknowns."""
        nothing = Estimate(0.0, 0.0)
        return self.shift_x or nothing, self.shift_y or nothing, self.shift_z or nothing


class Mount(Record):
    """Boresight angles (degrees) and lever arm of a camera (metres from the projection centre to the antenna, in the
    camera's frame). What was no unknown is null."""

    boresight_x: Estimate | None = None
    boresight_y: Estimate | None = None
    boresight_z: Estimate | None = None
    lever_x: Estimate | None = None
    lever_y: Estimate | None = None
    lever_z: Estimate | None = None

    @property
    def lever_m(self) -> Xyz:
        """The lever arm, zero where it was no unknown."""
        x, y, z = (0.0 if arm is None else arm.value for arm in (self.lever_x, self.lever_y, self.lever_z))
        return x, y, z


class LensChange(Record):
    """How parameters of a camera would change if they were unknowns."""

    change: dict[str, float] = Field({}, description="Parameter -> by how much it would change.")
    worth: float = Field(
        0.0,
        description="By how much that lowers the sum of squares, over what is asked for: above 1 it is significant.",
    )


class FlightLens(LensChange):
    """How a lens of its own for one flight would differ from that of the largest flight."""

    flight: str
    images: int


class Correlation(NamedTuple):
    """Two parameters of one camera and their correlation."""

    first: str
    second: str
    value: float


class Calibration(Record):
    """The calibration of one camera. cx and cy count from the corner of the first pixel, as in camera files."""

    images: int
    parameters: dict[str, Parameter]
    if_freed: LensChange = Field(description="What parameters that settings hold would change by.")
    correlations: list[Correlation] = Field(description="Up to five pairs of parameters correlated by more than 0.9.")
    flights: list[FlightLens] = Field(description="Flights other than the largest that tell of a lens.")


class HeightErrors(Record):
    """Expected errors of the heights of points. Lengths are metres, or units of the frame where `metric` is false."""

    metric: bool
    sigma: float = Field(description="Median standard deviation of a height.")
    bowl: float = Field(description="Standard deviation of the height of the middle above the border.")
    tilt: float = Field(description="Standard deviation of the height of one side above the middle.")
    reach: float = Field(description="Half the extent that bowl and tilt are of.")
    pixel: float = Field(description="Size of a pixel on the ground.")
    points: list[Xyz] = Field(description="x, y and standard deviation of the height of points over the block.")

    def in_pixels(self, length: float) -> float:
        """A length of the frame in pixels on the ground."""
        return length / self.pixel


class ControlInGroup(Record):
    """What control points did in the adjustment of one group."""

    used: list[str] = Field(description="Names of the points that took part.")
    wrong: list[str] = Field(description="Names of points that the others contradict; they were left out.")
    exchanged: list[str] = Field(description="Names of points whose names are exchanged; they were left out.")
    fault: str = Field(description="What is wrong with the list as a whole, empty for nothing.")
    held_out: Literal["check points", "leave one out"] = Field(description="At which points errors were determined.")
    held_out_rms_m: Xyz | None = Field(description="Root mean square error at these points with control, metres.")
    without_rms_m: Xyz | None = Field(description="The same without control.")
    kept: bool = Field(description="Whether control makes these points better.")


class GroupResult(Record):
    """A group of images that hang together and were adjusted together."""

    kind: PlacementKind = Field(
        description="How it lies in the world: by given poses, by positions, or level in a frame of its own."
    )
    registered: list[str] = Field(description="Image ids that were added to the group by its points.")
    images: int
    first_image: str = Field("", description="Image id of the first of its images, which tells groups apart.")
    points: int
    track_length: float = Field(description="Images per point, mean.")
    reprojection_error_px: float | None = Field(description="Mean, pixels.")
    sigma_px: float | None = Field(None, description="Standard deviation of a coordinate of an image point, pixels.")
    positions: PositionResiduals | None = None
    flights: list[FlightCorrection] = Field([], description="Flights of which something was found.")
    mounts: dict[str, Mount] = Field({}, description="Camera id -> boresight and lever arm.")
    calibration: dict[str, Calibration] = Field({}, description="Camera id -> calibration.")
    heights: HeightErrors | None = Field(None, description="Null with few points.")
    control: ControlInGroup | None = None


class Similarity(Record):
    """A similarity transformation."""

    scale: float
    rotation_vector_deg: Xyz
    shift_m: Xyz


class Control(Record):
    """The adjusted block beside all surveyed points. Errors are adjusted less surveyed coordinates."""

    points: int
    control: int
    check: int
    not_measured_in_two_images: list[str]
    rays_do_not_meet: list[str]
    doubtful: list[str] = Field([], description="Names of control points that the others contradict.")
    image_residuals_px: dict[str, dict[str, tuple[float, float]]] = Field(
        description="Name -> image id -> x, y: measured less seen where the rays of the point meet."
    )
    reprojection_error_px: float | None = Field(description="Root mean square of the lengths of these.")
    point_sigmas_m: dict[str, Xyz] = Field(
        {}, description="Name -> standard deviations of its residual, of survey and image measurements together."
    )
    sigmas_m: Xyz | None = Field(None, description="Medians of those of the check points, else of the control points.")
    residuals: dict[str, Xyz] = Field({}, description="Name -> x, y, z after the transformation, metres.")
    checks: list[str] = Field([], description="Names of the check points.")
    ground_pixel_m: float | None = Field(None, description="Size of a pixel on the ground at the points.")
    transformation: Similarity | None = Field(
        None, description="Similarity onto the control points; null with fewer than three."
    )
    control_rmse_m: Xyz | None = None
    check_rmse_m: Xyz | None = None
    check_kind: Literal["check points", "leave one out"] | None = None
    offset_m: Xyz | None = Field(
        None, description="From the block as it is to the surveyed points, median; null in a frame without metres."
    )


class Worst(NamedTuple):
    """The image with the largest value."""

    image: str
    value: float


class PoseResiduals(Record):
    """Adjusted less given poses, and reprojection errors of images, over the whole block; see residuals.csv. `_rms` and
    `_median` (of absolute values) are along x, y and z. What nothing was given for is null."""

    images: int
    positions: int = Field(description="How many positions were compared.")
    rotations: int = Field(description="How many attitudes were compared.")
    position_m_rms: Xyz | None = None
    position_m_median: Xyz | None = None
    position_m_worst: Worst | None = None
    position_sigmas_rms: Xyz | None = None
    position_sigmas_median: Xyz | None = None
    position_sigmas_worst: Worst | None = None
    rotation_deg_rms: Xyz | None = None
    rotation_deg_median: Xyz | None = None
    rotation_deg_worst: Worst | None = None
    rotation_sigmas_rms: Xyz | None = None
    rotation_sigmas_median: Xyz | None = None
    rotation_sigmas_worst: Worst | None = None
    error_px_median: float | None = None
    error_px_worst: Worst | None = None
