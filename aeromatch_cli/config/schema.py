"""The settings: one model for the whole tree; each strategy class brings its own keys and defaults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    field_validator,
    model_validator,
)
from pydantic_core import CoreSchema

from aeromatch_cli.blocks.pose_files import POSE_FORMATS
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.consistencies import CONSISTENCIES, BlockConsistency
from aeromatch_cli.strategies.enhancers import ENHANCERS
from aeromatch_cli.strategies.exporters import EXPORTERS
from aeromatch_cli.strategies.extractors import EXTRACTORS
from aeromatch_cli.strategies.filters import FILTERS
from aeromatch_cli.strategies.matchers import MATCHERS
from aeromatch_cli.strategies.orienters import ORIENTERS, FirstPass
from aeromatch_cli.strategies.pairings import PAIRINGS
from aeromatch_cli.strategies.pairings.similar import Similar
from aeromatch_cli.strategies.refiners import REFINERS
from aeromatch_cli.strategies.refiners.least_squares import LeastSquares
from aeromatch_cli.strategies.simulators import SIMULATORS
from aeromatch_cli.strategies.steps import STEPS

LensParameter = Literal["f", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "b1", "b2"]


def listed(value: Any) -> Any:
    """`a+b` is a list; null, `none` and nothing are the empty one."""
    if value is None or value in ("", "none"):
        return []
    return [name.strip() for name in value.split("+")] if isinstance(value, str) else value


LensParameters = Annotated[tuple[LensParameter, ...], BeforeValidator(listed)]


def named(value: Any) -> Any:
    """A bare name stands for the strategy with its defaults."""
    return {"name": value} if isinstance(value, str) else value


def chain(value: Any) -> Any:
    """`a+b` and a single mapping are chains too; null and `none` are the empty one."""
    if value is None or value == "none":
        return []
    if isinstance(value, str):
        value = [name.strip() for name in value.split("+")]
    elif isinstance(value, Mapping):
        value = [value]
    return [named(item) for item in value] if isinstance(value, Sequence) else value


# Section -> name -> strategy. Of a process that called `add_strategies` they are more than the product's own.
FAMILIES: dict[str, dict[str, type[Strategy]]] = {
    "orient": dict(ORIENTERS),
    "pairs": dict(PAIRINGS),
    "enhance": dict(ENHANCERS),
    "simulate": dict(SIMULATORS),
    "extract": dict(EXTRACTORS),
    "match": dict(MATCHERS),
    "cascade": dict(STEPS),
    "filter": dict(FILTERS),
    "refine": dict(REFINERS),
    "consistency": dict(CONSISTENCIES),
    "export": dict(EXPORTERS),
}


@dataclass(frozen=True)
class _OneOf:
    """Annotates a setting as "one of this family, chosen by `name`". pydantic asks for the family's table whenever it
    builds a schema, not when this file is read: strategies can be added to the table in between."""

    family: str

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        classes = tuple(FAMILIES[self.family].values())
        chosen = classes[0] if len(classes) == 1 else Annotated[Union[classes], Field(discriminator="name")]  # noqa: UP007
        return handler.generate_schema(Annotated[chosen, BeforeValidator(named)])


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class BlockSettings(_Section):
    """What was flown: images, poses, cameras, ground."""

    images: str = Field(
        "",
        description="Folder of images, searched recursively; or a zip archive, or the URL of an object store or web "
        "server (`s3://bucket/block`), of which copies are kept in the cache folder.",
    )
    poses: str = Field(
        "exif", description="Pose file of any format in `pose_format`, `exif` for GPS and XMP angles, or `none`."
    )
    pose_format: Literal["auto", *POSE_FORMATS] = Field(  # type: ignore[valid-type]
        "auto",
        description="Format of the pose file; auto: by its content. Needed where that leaves open what angles are.",
    )
    cameras: str = Field(
        "exif",
        description="COLMAP cameras.txt, YAML or JSON; `exif` (grouped by make, model, serial number, lens, band, "
        "focal length and size); or `folder` (one camera per folder).",
    )
    crs: str = Field(
        "auto",
        description="World frame: a code such as EPSG:32633, or with its heights EPSG:32633+5773, `local`, or `auto` "
        "(the UTM zone of the median position).",
    )
    heights: str = Field(
        "auto",
        description="What heights of positions count from: `ellipsoid`, a vertical CRS such as EPSG:5773, or `auto` "
        "(as their file states). Where `crs` names other heights (EPSG:32633+5773) they are brought to those, which "
        "needs PROJ's grid of the geoid.",
    )
    height_shift_m: float = Field(
        0.0,
        ge=-12_000.0,
        le=12_000.0,
        description="Metres that are added to the heights of all positions. Where these count from the ellipsoid and "
        "control points or the DEM from sea level: the geoid's height above the ellipsoid there, with a minus.",
    )
    ground: str = Field(
        "auto",
        description="Ground height in metres (or with its unit, such as `112 ft`), a DEM file, or `auto` (the terrain "
        "that `orient` finds, else from relative altitudes).",
    )
    masks: str = Field(
        "",
        description="Folder of masks in COLMAP's naming (a/1.jpg.png masks a/1.jpg; 0 = ignore), or one mask for all "
        "images.",
    )
    exclude: str = Field(
        "",
        description="Images that are left out: names, patterns such as takeoff/*, or files with one of these in each "
        "line; separated by commas.",
    )
    gcp: str = Field(
        "",
        description="Ground control points: ODM's gcp_list.txt, Pix4D's or Metashape's coordinates (CSV), or "
        "Metashape's markers (XML).",
    )
    gcp_marks: str = Field(
        "",
        description="Image measurements of the control points where they stand in a file of their own (image, label, "
        "x, y); empty: the one beside the coordinates.",
    )
    gcp_use: Literal["adjust", "check"] = Field(
        "adjust",
        description="What control points are for: the fit, except those that are marked as check points (adjust), or "
        "none of them (check).",
    )
    ground_shots: Literal["keep", "drop"] = Field(
        "keep",
        description="Pictures that were taken on the ground, of reflectance panels and before take-off: keep (they are "
        "named) or drop.",
    )
    angles: Literal["auto", "gimbal", "nadir"] = Field(
        "auto",
        description="Convention of yaw, pitch, roll: at zero the camera looks forward (gimbal, DJI) or down (nadir, "
        "Parrot, Metashape, Pix4D); auto: by the tags' origin in EXIF, gimbal in a pose list.",
    )
    sigma_position_m: float = Field(
        5.0,
        gt=0,
        description="Standard deviation of each coordinate of a position that states none, metres. Larger: wider "
        "search windows, looser pose priors.",
    )
    sigma_angle_deg: float = Field(
        3.0,
        gt=0,
        description="Standard deviation of each angle of an attitude that states none, degrees. Larger: wider search "
        "windows.",
    )
    max_size_px: int = Field(
        0,
        ge=0,
        description="Longer side to which larger images are reduced, pixels; 0 = never. Smaller: less time and "
        "memory, fewer details.",
    )

    @field_validator("crs", "ground", mode="before")
    @classmethod
    def _number_as_text(cls, value: Any) -> Any:
        return str(value) if isinstance(value, int | float) and not isinstance(value, bool) else value


class AdjustSettings(_Section):
    """What the bundle adjustment may find of cameras."""

    calibration: Literal["auto", "given", "focal", "brown"] = Field(
        "auto",
        description="Unknowns of cameras: those that the block determines (auto), none (given), the focal length "
        "(focal), or the whole of Brown's model whatever the block says of it (brown). Each has a prior by what was "
        "stated.",
    )
    free: LensParameters = Field(
        (), description="Parameters that are unknowns in any case: f, cx, cy, k1, k2, k3, p1, p2, b1, b2."
    )
    hold: LensParameters = Field(
        (), description="Parameters that stay as they were stated in any case, such as b1+b2 or [b1, b2]."
    )
    rolling_shutter: bool = Field(
        True,
        description="Whether the read-out time of cameras is an unknown where the block determines it.",
    )

    @model_validator(mode="after")
    def _free_or_held(self) -> AdjustSettings:
        if both := [name for name in self.free if name in self.hold]:
            raise ValueError(f"free and hold both name {', '.join(both)}: leave it out of one of them")
        return self


class RunSettings(_Section):
    """How it is run; nothing here changes a result."""

    executor: Literal["serial", "processes", "dask"] = Field(
        "processes",
        description="Where tasks run: in this process, in worker processes, or on a dask cluster (extra `cluster`).",
    )
    scheduler: str = Field(
        "",
        description="Address of a dask scheduler, such as tcp://10.0.0.1:8786, with executor=dask. Empty: what "
        "DASK_SCHEDULER_ADDRESS names, else a local cluster.",
    )
    jobs: int = Field(
        0, ge=0, le=1024, description="Number of worker processes; 0 = one per core. Larger: faster, more memory."
    )
    memory: str = Field(
        "",
        description="Memory that all workers together may use, such as 8GB: fewer of them run side by side where they "
        "would need more. Empty: no limit.",
    )
    keep_images: bool = Field(False, description="Also keep enhanced and simulated pictures in the workspace.")
    report: bool = Field(
        True, description="Whether `run` ends with report/index.html. Without it, `aeromatch report` makes it any time."
    )


class Settings(_Section):
    """The whole tree."""

    workspace: str = Field("aeromatch-work", min_length=1, description="Folder for every result; made if missing.")
    seed: int = Field(0, ge=0, description="Seed of the estimators that verify pairs.")
    block: BlockSettings = Field(BlockSettings(), description="What was flown: images, poses, cameras, ground.")
    run: RunSettings = Field(RunSettings(), description="How it is run. Nothing here changes a result.")
    orient: Annotated[Any, _OneOf("orient")] = Field(
        ORIENTERS["global"](), description="How cameras, poses and terrain are found from a first pass."
    )
    pairs: Annotated[Any, _OneOf("pairs")] = Field(PAIRINGS["overlap"](), description="Which images are compared.")
    enhance: Annotated[Any, _OneOf("enhance")] = Field(
        ENHANCERS["none"](), description="What is done to an image before anything else."
    )
    simulate: Annotated[Any, _OneOf("simulate")] = Field(
        SIMULATORS["ground"](), description="From which virtual views an image is described."
    )
    extract: Annotated[Any, _OneOf("extract")] = Field(
        EXTRACTORS["sift"](), description="Features of each image, over all its views."
    )
    match: Annotated[Any, _OneOf("match")] = Field(
        MATCHERS["nearest"](), description="Which features of two images correspond."
    )
    cascade: Annotated[tuple[Annotated[Any, _OneOf("cascade")], ...], BeforeValidator(chain)] = Field(
        (),
        description="Further steps for pairs that the settings above leave with too few matches, or that may have many "
        "more, cheapest first; the "
        "matches of all steps of a pair are verified together.",
    )
    filter: Annotated[tuple[Annotated[Any, _OneOf("filter")], ...], BeforeValidator(chain)] = Field(
        (FILTERS["poselib"](),),
        min_length=1,  # without a filter no pair is ever verified
        description="Which matches are kept: a chain of filters; each gets what the previous one kept.",
    )
    refine: Annotated[Any, _OneOf("refine")] = Field(
        REFINERS["least-squares"](), description="How exactly the places of verified tie points are measured."
    )
    adjust: AdjustSettings = Field(AdjustSettings(), description="What the bundle adjustment may find of cameras.")
    consistency: Annotated[Any, _OneOf("consistency")] = Field(
        CONSISTENCIES["block"](), description="What is done about verified matches that contradict the adjusted block."
    )
    export: Annotated[tuple[Annotated[Any, _OneOf("export")], ...], BeforeValidator(chain)] = Field(
        (EXPORTERS["colmap"](),), description="Programs for which the result is written: a list."
    )

    @field_validator("filter")
    @classmethod
    def _one_that_verifies(cls, value: tuple[Strategy, ...]) -> tuple[Strategy, ...]:
        if not any(one.verifies for one in value):
            names = "+".join(getattr(one, "name", "") for one in value)
            evidence = next(name for name, strategy in FILTERS.items() if strategy.verifies)
            colours = " with extract.colours=true" if any("colour" in one.needs for one in value) else ""
            raise ValueError(f"{names} verifies nothing by itself; use {names}+{evidence}{colours}")
        return value

    @model_validator(mode="after")
    def _descriptors_for_matchers(self) -> Settings:
        made, wanted = self.extract.descriptors, self.match.reads_descriptors
        if not self.match.reads_pixels and (not made or wanted not in ("", made)):
            # What has no descriptors only pixels can compare; what has them need not be measured anew.
            readers = [
                name
                for name, one in MATCHERS.items()
                if one.reads_pixels != bool(made) and one.reads_descriptors in ("", made)
            ]
            makers = [name for name, one in EXTRACTORS.items() if one.descriptors and wanted in ("", one.descriptors)]
            raise ValueError(
                f"match {self.match.name} compares {wanted or 'any'} descriptors, extract {self.extract.name} makes "
                f"{made or 'none'}; use match {' or '.join(readers)}, or extract {' or '.join(makers)}"
            )
        return self

    @model_validator(mode="after")
    def _colours_for_filters(self) -> Settings:
        readers = [getattr(one, "name", "") for one in self.filter if "colour" in one.needs]
        if readers and self.cascade:
            raise ValueError(
                f"filter {'+'.join(readers)} compares colours, which are not kept where steps of a cascade are joined; "
                "leave it out, or add --set cascade=none"
            )
        if readers and not self.extract.colours:
            raise ValueError(
                f"filter {'+'.join(readers)} compares colours that are not kept; add --set extract.colours=true"
            )
        return self

    @field_validator("export", "cascade")
    @classmethod
    def _one_folder_each(cls, value: tuple[Strategy, ...]) -> tuple[Strategy, ...]:
        names = [getattr(one, "name", "") for one in value]
        if len(set(names)) < len(names):
            raise ValueError(f"each at most once, its folder has its name: {', '.join(names)}")
        return value

    @field_validator("cascade")
    @classmethod
    def _cheapest_first(cls, value: tuple[Strategy, ...]) -> tuple[Strategy, ...]:
        """The table of steps is in that order."""
        order = list(STEPS)
        return tuple(sorted(value, key=lambda step: order.index(step.name)))  # type: ignore[attr-defined]

    @model_validator(mode="after")
    def _keypoints_in_cascades(self) -> Settings:
        if self.cascade and self.match.reads_pixels:
            raise ValueError(f"a cascade joins keypoints, and match {self.match.name} measures points without any")
        if self.extract.name == "learned" and any(step.name == "learned" for step in self.cascade):
            raise ValueError(
                "extract=learned makes what the step learned of the cascade would make again; add "
                "--set cascade=none, or --set extract=sift"
            )
        return self

    @property
    def first_pass(self) -> FirstPass | None:
        """How the block is oriented from a first pass, None where poses stay as they are given and none is made."""
        return self.orient if isinstance(self.orient, FirstPass) else None

    @property
    def keeps_poses(self) -> bool:
        """Whether a first pass is made, and given poses stay all the same."""
        return self.first_pass is not None and not self.first_pass.replaces

    @property
    def similar(self) -> Similar | None:
        """How pairs are chosen by what images look like, None where they are not."""
        return self.pairs if isinstance(self.pairs, Similar) else None

    @property
    def least_squares(self) -> LeastSquares | None:
        """How tie points are measured, None where they are not: matchers that read pixels have measured them."""
        measured = isinstance(self.refine, LeastSquares) and not self.match.reads_pixels
        return self.refine if measured else None

    @property
    def rejection(self) -> BlockConsistency | None:
        """By what the adjusted block rejects matches, None where it rejects none: those of matchers that read pixels
        have no keypoints that it could see."""
        judged = isinstance(self.consistency, BlockConsistency) and not self.match.reads_pixels
        return self.consistency if judged else None


def add_strategies(families: Mapping[str, Mapping[str, type[Strategy]]]) -> None:
    """Let the settings of this process name further strategies: family -> name -> class."""
    for family, table in families.items():
        FAMILIES[family].update(table)
    Settings.model_rebuild(force=True)
