"""check: a dry run. Decodes every image, times a sample, and says what a run would need; writes nothing."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aeromatch_cli.data import Features, Image
from aeromatch_cli.images import shrink_camera
from aeromatch_cli.stages import enhance, extract, simulate
from aeromatch_cli.stages.common import Context

# Measured on SIFT in tiles of 4 megapixels: a worker's libraries, and bytes per pixel of the source or of its views
# together, whichever are more: a view of a turned or tilted image is larger than the image.
_BASE_MB = 350.0
_BYTES_PER_PIXEL = 12.0
_TILE_MB = 700.0
_BYTES_PER_DESCRIPTOR = 170.0
_BYTES_PER_MATCH = 60.0


@dataclass(frozen=True)
class Check:
    """Lines for people, estimate for machines, images that cannot be read."""

    lines: tuple[str, ...]
    estimate: dict[str, Any]
    failures: tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False)
class _Trial:
    """An image to decode; `sample`: also find its features, in memory, and time it."""

    task: extract.ExtractTask
    sample: bool


def _try_image(trial: _Trial) -> tuple[float, Features | None]:
    started = time.perf_counter()
    if not trial.sample:
        enhance.load_source(trial.task.views.source, colour=False)
        return time.perf_counter() - started, None
    pictures, _ = simulate.render(trial.task.views)
    source = trial.task.views.source
    features = trial.task.extractor(shrink_camera(source.camera, source.scale), pictures)
    return time.perf_counter() - started, features


def run(context: Context) -> Check:
    """Try every image, and the strategies on the first pair that can be tried."""
    images = list(context.block.images)
    sampled = _sample(context)
    trials = [_Trial(extract.make_task(context, image), image.image_id in sampled) for image in images]
    largest_px = max(_pixels(image, trial) for image, trial in zip(images, trials, strict=True))
    outcomes = context.executor.run(_try_image, trials, "check")
    failures = tuple((i.name, o.error) for i, o in zip(images, outcomes, strict=True) if o.value is None)
    timed = {
        image.image_id: outcome.value
        for image, outcome in zip(images, outcomes, strict=True)
        if outcome.value is not None and image.image_id in sampled
    }
    estimate = _estimate(context, len(images), largest_px, timed)
    estimate["readable_images"] = len(images) - len(failures)
    return Check(_lines(context, estimate, len(images)), estimate, failures)


def _sample(context: Context) -> set[str]:
    """Both images of the pair in the middle of the list."""
    pair = context.pairs[len(context.pairs) // 2]
    return {pair.image_id0, pair.image_id1}


def _pixels(image: Image, trial: _Trial) -> int:
    """What an image is worked on as: its own pixels, or those of all its views."""
    views = simulate.views_of(trial.task.views)
    source = trial.task.views.source
    if source.enhancer.beside and not source.spared:
        views *= 2
    return max(image.width_px * image.height_px, sum(view.width_px * view.height_px for view in views))


def _estimate(
    context: Context, images: int, largest_px: int, timed: dict[str, tuple[float, Features | None]]
) -> dict[str, Any]:
    """images: how many. largest_px: of the image, or its views, that needs most memory."""
    seconds_image = max((seconds for seconds, _ in timed.values()), default=float("nan"))
    descriptors = max((len(f.descriptors) for _, f in timed.values() if f is not None), default=0)
    seconds_pair, matches = _time_pair(context, timed)
    jobs = context.executor.jobs
    megapixels = largest_px / 1e6
    memory_mb = _BASE_MB + _BYTES_PER_PIXEL * megapixels + min(_TILE_MB, _TILE_MB * megapixels / 4.0)
    disk = images * descriptors * _BYTES_PER_DESCRIPTOR + len(context.pairs) * matches * _BYTES_PER_MATCH
    seconds = (images * seconds_image + len(context.pairs) * seconds_pair) / jobs
    return {
        "pairs": len(context.pairs),
        "seconds_per_image": round(seconds_image, 3) if timed else None,
        "seconds_per_pair": round(seconds_pair, 4),
        "seconds": round(seconds, 1) if timed else None,
        "memory_mb": round(memory_mb * jobs),
        "disk_mb": round(disk / 1e6, 1),
        "disk_free_mb": round(shutil.disk_usage(_existing(context.workspace.root)).free / 1e6),
    }


def _time_pair(context: Context, timed: dict[str, tuple[float, Features | None]]) -> tuple[float, int]:
    """Seconds to match and judge the sampled pair, and its matches; zero where it could not be tried."""
    pair = context.pairs[len(context.pairs) // 2]
    features = [timed.get(i, (0.0, None))[1] for i in (pair.image_id0, pair.image_id1)]
    if features[0] is None or features[1] is None:
        return 0.0, 0
    geometry = context.geometry(pair)
    context.settings.match(features[0], features[1], geometry)  # the first call builds what is built once per process
    started = time.perf_counter()
    matches = context.settings.match(features[0], features[1], geometry)
    return time.perf_counter() - started, len(matches.indices)


def _existing(path: Path) -> Path:
    while not path.exists():
        path = path.parent
    return path


def _lines(context: Context, estimate: dict[str, Any], images: int) -> tuple[str, ...]:
    seconds = estimate["seconds"]
    duration = "unknown (the sample could not be read)" if seconds is None else f"about {_duration(seconds)}"
    return (
        f"images    {estimate['readable_images']} of {images} readable",
        f"pairs     {estimate['pairs']}",
        f"time      {duration} with {context.executor.jobs} jobs",
        f"memory    about {estimate['memory_mb']} MB with {context.executor.jobs} jobs",
        f"disk      about {estimate['disk_mb']} MB needed, {estimate['disk_free_mb']} MB free",
    )


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
