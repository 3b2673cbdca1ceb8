"""Models of a block from the matches of its first pass, or of a further one where that has better ones."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

from aeromatch_cli.errors import InputError
from aeromatch_cli.images.scaling import scale_within
from aeromatch_cli.results.stages import FurtherFirstPass
from aeromatch_cli.sfm.earlier_datum import Before
from aeromatch_cli.sfm.mapping import MAPPERS, Mapper, Model, map_block
from aeromatch_cli.sfm.model_extension import grown
from aeromatch_cli.sfm.model_validation import FEWEST_IMAGES, only, sound_part
from aeromatch_cli.sfm.pair_start import started_from_pair
from aeromatch_cli.sfm.solution import FirstPassMatches, Solution, from_models
from aeromatch_cli.stages import first_pass
from aeromatch_cli.stages.contents import contents_of
from aeromatch_cli.stages.context import Context
from aeromatch_cli.strategies.orienters import FirstPass

log = logging.getLogger("aeromatch")

# Images that no model holds are mapped again by themselves so often.
_MAX_ROUNDS = 4
# A block falls into parts where the largest model holds fewer than this share of its images though so many are matched.
_WHOLE = 0.8
# Images of a block that a model may lack without a second look at all images.
_FEW_LEFT_OUT = 0.02
# A model with this many times the images of another says more of given positions.
_BY_CHANCE = 2
# An exact match of the first pass lies this near its epipolar line, in pixels of its own reduced image.
_EXACT_PX = 3.0


@dataclass(frozen=True)
class Mapped:
    """A first pass with its verified matches, and the models of these, the largest first.

    stopped: why there is none, where the mapper stopped on a fault: this says nothing of the block.
    """

    recipe: FirstPass
    first: Context
    evidence: FirstPassMatches
    models: tuple[Model, ...]
    stopped: str = ""

    @property
    def contradicted(self) -> bool:
        """Whether the given positions do not fit: the largest model contradicts them, or nothing was mapped."""
        return not self.models or bool(self.models[0].figures.contradiction)

    def beats(self, other: Mapped) -> bool:
        """Whether its largest model has more images, and none that models at their right places hold is lost for it.

        A small model may fit positions by chance: a larger one that contradicts them beats it all the same.
        """
        largest, others = _largest(self.models), _largest(other.models)
        loses = _images(self.models) < _images(other.models) or (self.contradicted and largest < _BY_CHANCE * others)
        return largest > others and (other.contradicted or not loses)


def best_mapped(
    context: Context, recipe: FirstPass, first: Context, evidence: FirstPassMatches
) -> tuple[Mapped, list[FurtherFirstPass]]:
    """Return models of a first pass, or of a further one where that has better ones, and what further ones were
    tried."""
    best = _mapped(context, recipe, first, evidence)
    tried: list[FurtherFirstPass] = []
    for words, further in (
        ("images in full size", _with_finer_images),
        ("more keypoints", _with_more_keypoints),
        ("pairs chosen without positions", _without_positions),
    ):
        found = further(context, best)
        if found is None:
            continue
        counts = {"images": _largest(best.models), "images_then": _largest(found.models)}
        used = found.beats(best)
        tried.append(FurtherFirstPass(change=words, used=used, **counts))
        best = found if used else best
    return best, tried


def _mapped(context: Context, recipe: FirstPass, first: Context, evidence: FirstPassMatches) -> Mapped:
    try:
        return Mapped(recipe, first, evidence, _sound_models(context, recipe, first, evidence))
    except InputError as error:  # matches are found without orientation, too
        return Mapped(recipe, first, evidence, (), str(error))


def _with_finer_images(context: Context, best: Mapped) -> Mapped | None:
    """Map the block from a first pass that halves no image, where images are left out; None otherwise.

    Blocks that need it: every 3rd image of lewis, 10 instead of 7 of 11 in one model, and of seneca, 9 instead of 8 of
    10 without positions.
    """
    images = len(context.block.images)
    finer = first_pass.finer(best.recipe, context.block) if best.recipe.replaces else None
    if finer is None or _largest(best.models) >= (1.0 - _FEW_LEFT_OUT) * images:
        return None
    return _mapped(context, finer, *evidence_of(context, finer))


def _with_more_keypoints(context: Context, best: Mapped) -> Mapped | None:
    """Map the block from a first pass with more keypoints, where it falls into parts; None otherwise."""
    falls_apart = _largest(best.models) < _WHOLE * len(context.block.images) <= len(best.evidence.matched)
    dearer = first_pass.thorough(best.recipe, best.first) if falls_apart and best.recipe.replaces else None
    if dearer is None:
        return None
    return _mapped(context, dearer, *evidence_of(context, dearer))


def _without_positions(context: Context, best: Mapped) -> Mapped | None:
    """Map the block from pairs that were not chosen by positions, where these do not fit the images; None otherwise."""
    if not context.block.poses or not best.contradicted:
        return None
    first, evidence = evidence_of(context, best.recipe, by_position=False)
    if {(p.image_id0, p.image_id1) for p in first.pairs} <= {(p.image_id0, p.image_id1) for p in best.first.pairs}:
        return None
    return _mapped(context, best.recipe, first, evidence)


def _sound_models(context: Context, recipe: FirstPass, first: Context, evidence: FirstPassMatches) -> tuple[Model, ...]:
    """Models that explain their matches, the largest first. What is left after one is mapped again by itself.

    A block that needs it: rendered suburb, flight `mixed`, seed 5, 12 images with positions.

    Raises InputError where no mapper finds one and the last to try stopped on a fault.
    """
    models: list[Model] = []
    left = evidence.matched
    for _ in range(_MAX_ROUNDS):
        try:
            found = _one_round(context, recipe, first, evidence, left)
        except InputError:
            if not models:
                raise
            break
        models += found
        left = left - {i for model in found for i in model.rotations}
        if not found or len(left) < FEWEST_IMAGES:
            break
    block = context.block
    camera_ids = {image.image_id: image.camera_id for image in block.images}
    if not models:
        lenses = {image_id: block.cameras[camera_id] for image_id, camera_id in camera_ids.items()}
        ups = {i: one.rotation[:, 2] for i, one in context.observed.angles.items()}
        start = started_from_pair(evidence.pairs, block.poses, lenses, evidence.thresholds_px, ups)
        return () if start is None else (start,)
    return grown(models, evidence.pairs, camera_ids, block.cameras, evidence.thresholds_px, block.poses)


def _one_round(
    context: Context, recipe: FirstPass, first: Context, evidence: FirstPassMatches, image_ids: set[str]
) -> list[Model]:
    """Sound models of some images; by the other mapper where that finds more of them.

    Blocks that need it: rendered suburbs, flight `mixed`, seeds 917, 5101 and 5102, 7 images, which a first pass with
    more keypoints orients as well, in five times the time.

    Raises InputError where none is found and a mapper stopped on a fault.
    """
    best: list[Model] = []
    fault: InputError | None = None
    for mapper in (recipe.mapper, *(name for name in MAPPERS if name != recipe.mapper)):
        try:
            mapped = _mapped_images(context, first, mapper, image_ids)
            found = _sound_parts(context, first, evidence, mapper, mapped)
        except InputError as error:  # the other mapper may do
            log.warning("warning: %s", error)
            fault = error
            continue
        best = found if _images(found) > _images(best) else best
        if found and _images(found) == _images(mapped):
            break
    if fault is not None and not best:
        raise fault
    return best


def _sound_parts(
    context: Context, first: Context, evidence: FirstPassMatches, mapper: Mapper, models: Sequence[Model]
) -> list[Model]:
    """The models as far as they explain their matches, each image in the largest that has it."""
    found: list[Model] = []
    taken: set[str] = set()
    for model in sorted(models, key=lambda model: -len(model.rotations)):
        part = _sound(context, evidence, only(model, model.rotations.keys() - taken))
        if part is not None and len(part.rotations) < _WHOLE * len(model.rotations):
            part = _by_itself(context, first, evidence, mapper, part)
        if part is not None:
            found.append(part)
            taken |= part.rotations.keys()
    return found


def _by_itself(context: Context, first: Context, evidence: FirstPassMatches, mapper: Mapper, part: Model) -> Model:
    """The part of a model mapped once more without the others, with which it was placed, levelled and scaled: as they
    are in wrong places, so is it.

    A block that needs it: every 3rd image of brighton, two triples of images that share one.
    """
    try:
        again = _mapped_images(context, first, mapper, set(part.rotations))
    except InputError:  # of fewer images than before
        return part
    sound = [one for model in again if (one := _sound(context, evidence, model)) is not None]
    best = max(sound, key=lambda model: len(model.rotations), default=part)
    return best if len(best.rotations) >= len(part.rotations) else part


def _sound(context: Context, evidence: FirstPassMatches, model: Model) -> Model | None:
    cameras = {**context.block.cameras, **model.cameras}
    of_images = {image.image_id: cameras[image.camera_id] for image in context.block.images}
    return sound_part(model, evidence.pairs, of_images, evidence.thresholds_px, context.block.poses)


def _mapped_images(context: Context, first: Context, mapper: Mapper, image_ids: set[str]) -> tuple[Model, ...]:
    """Models of the pairs of the first pass between some images. InputError where the mapper stops on a fault."""
    pairs = tuple(pair for pair in first.pairs if {pair.image_id0, pair.image_id1} <= image_ids)
    what = "" if first.workspace == context.workspace else "first pass: "
    with context.executor.step(f"{what}{mapper} mapping of {len(image_ids)} images"):
        return map_block(contents_of(replace(first, pairs=pairs)), context.observed, mapper)


def remapped(context: Context) -> Solution | None:
    """Return the orientation from the verified matches of the block, which are more than its first pass had; None where
    they give none, or one in another frame: what the block calls a metre, and its CRS, are those of its own."""
    recipe, held = context.settings.first_pass, context.given.block
    if recipe is None or not recipe.replaces or context.settings.match.reads_pixels:
        return None
    as_given = replace(context, block=replace(context.block, poses=held.poses))
    pairs = list(first_pass.verified_points(context))
    evidence = FirstPassMatches(as_given.block, pairs, thresholds_px(context), held.cameras)
    found = _mapped(as_given, recipe, context, evidence)
    if not found.models:
        return None
    solution = from_models(evidence, found.models, Before(), context.given.angles)
    return solution if (solution.result.frame == "world") == context.block.metric else None


def _images(models: Sequence[Model]) -> int:
    """Images of all models."""
    return sum(len(model.rotations) for model in models)


def _largest(models: Sequence[Model]) -> int:
    """Images of the largest model."""
    return max((len(model.rotations) for model in models), default=0)


def evidence_of(
    context: Context, recipe: FirstPass, *, by_position: bool = True, look: bool = False
) -> tuple[Context, FirstPassMatches]:
    """Return the context of a first pass that has been run, and its verified matches. look: whether it is a look at
    given poses, which another pass may follow."""
    prepared = first_pass.prepared(context, recipe, "first pass on given poses" if look else "first pass")
    first, failed = first_pass.run(prepared, recipe, by_position=by_position)
    pairs = list(first_pass.verified_points(first)) if first.pairs else []
    return first, FirstPassMatches(context.block, pairs, thresholds_px(first), context.given.block.cameras, failed)


def thresholds_px(first: Context) -> dict[str, float]:
    """Return image_id -> error of an exact match of a first pass, stored pixels."""
    limit = first.settings.block.max_size_px
    return {
        image.image_id: _EXACT_PX / scale_within(limit, image.width_px, image.height_px) for image in first.block.images
    }
