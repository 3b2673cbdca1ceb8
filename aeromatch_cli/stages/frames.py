"""frames: pictures of a video that make a block, with a list of their positions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from aeromatch_cli.blocks.flight_tracks import FlightTrack, poses_text, read_track, track_beside, utc_seconds
from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.executor import Executor
from aeromatch_cli.files import translated_os_errors, write_atomically, write_text
from aeromatch_cli.images.files import write_jpeg
from aeromatch_cli.images.video import chosen_frames

_LEAST_OVERLAP, _MOST_OVERLAP = 0.3, 0.95


def write_frames(
    video: Path, out: Path, executor: Executor, *, track: Path | None = None, start: str = "", overlap: float = 0.8
) -> tuple[list[str], dict[str, Any]]:
    """Write out/<video>_<number>.jpg and, where a track is known, out/poses.csv; what was done, for people and
    machines. track: SRT or GPX, None for the one beside the video. start: UTC of the first frame, which a GPX track
    needs. Raises ConfigError."""
    if not _LEAST_OVERLAP <= overlap <= _MOST_OVERLAP:
        raise ConfigError(f"--overlap {overlap:g}: give a share between {_LEAST_OVERLAP:g} and {_MOST_OVERLAP:g}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"{out} exists and is not replaced: give another folder")
    path = track or track_beside(video)
    known = None if path is None else read_track(path)
    began_s = _began_s(known, path, start)
    names: list[str] = []
    places: list[FloatArray | None] = []
    with executor.step("frames"):
        for frame in chosen_frames(video, overlap):
            with translated_os_errors(out):
                out.mkdir(parents=True, exist_ok=True)
            names.append(f"{video.stem}_{frame.number:06d}.jpg")
            places.append(None if known is None else known.at(began_s + frame.time_s))
            pixels = frame.pixels
            write_atomically(out / names[-1], lambda stream, pixels=pixels: write_jpeg(stream, pixels))  # type: ignore[misc]
    located = sum(place is not None for place in places)
    lines = [f"{len(names)} frames of {video.name} written to {out}"]
    facts: dict[str, Any] = {"frames": len(names), "folder": str(out), "with_position": located, "poses": None}
    if path is None:
        lines.append(f"no positions: no {video.stem}.SRT or {video.stem}.GPX lies beside the video; give --track FILE")
    elif not located:
        lines.append(
            f"no positions: {path.name} has none for any of the frames: is it of this video, is --start right?"
        )
    else:
        write_text(out / "poses.csv", poses_text(names, places))
        heights = sum(place is not None and bool(np.isfinite(place[2])) for place in places)
        lines.append(f"{located} of them with position, {heights} with height, by {path.name}")
        facts["poses"] = str(out / "poses.csv")
    return [*lines, f"next      aeromatch run --images {out} --poses {facts['poses'] or 'none'}"], facts


def _began_s(track: FlightTrack | None, path: Path | None, start: str) -> float:
    """When the first frame was taken, in the track's time."""
    if track is None or not track.utc:
        return 0.0
    if not start:
        raise ConfigError(
            f"{path} counts in UTC: give the time of the video's first frame with --start 2026-05-01T10:00:00Z"
        )
    try:
        return utc_seconds(start)
    except ValueError as error:
        raise ConfigError(f"--start {start!r} is no time: write it as 2026-05-01T10:00:00Z") from error
