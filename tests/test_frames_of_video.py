"""Frames of a video are as far apart as their overlap asks for, and stand where subtitles or a track say."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import invoke

from aeromatch_cli.blocks.flight_tracks import poses_text, read_track, track_beside
from aeromatch_cli.blocks.pose_files import read_pose_file
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.images.video import chosen_frames, shared

WIDTH, HEIGHT, RATE_HZ = 320, 240, 30.0


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """4 s of flight along x at 2 pixels a frame, with 1 s of hovering after the first second: 180 px in all."""
    rng = np.random.default_rng(5)
    ground = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (HEIGHT, 700)).astype(np.float32), (0, 0), 2.0)
    ground = np.clip(128.0 + 6.0 * (ground - ground.mean()), 0.0, 255.0).astype(np.uint8)
    path = tmp_path_factory.mktemp("video") / "DJI_0001.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), RATE_HZ, (WIDTH, HEIGHT))
    for number in range(120):
        left = place_px(number)
        writer.write(cv2.cvtColor(ground[:, left : left + WIDTH], cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def place_px(number: int) -> int:
    """Left edge of a frame on the ground."""
    return 2 * (min(number, 30) + max(0, number - 60))


def subtitles(rows: list[str]) -> str:
    blocks = [
        f'{k + 1}\n00:00:{k:02d},000 --> 00:00:{k + 1:02d},000\n<font size="28">FrameCnt: {k}\n{row}</font>\n'
        for k, row in enumerate(rows)
    ]
    return "\n".join(blocks)


@pytest.mark.parametrize("overlap", [0.8, 0.6])
def test_frames_overlap_as_asked_and_none_is_taken_where_the_camera_hovers(video: Path, overlap: float) -> None:
    places = [place_px(frame.number) for frame in chosen_frames(video, overlap)]
    assert places[0] == 0
    assert len(places) == 1 + int(180 / ((1.0 - overlap) * WIDTH)) or len(places) == 2 + int(
        180 / ((1.0 - overlap) * WIDTH)
    )
    found = 1.0 - np.diff(places) / WIDTH
    # Frames are looked at every 6 px, which are 2 % of the picture.
    assert found.min() >= overlap - 0.025
    assert found.max() <= overlap + 0.045


def test_of_the_frames_in_question_the_sharpest_is_taken(video: Path, tmp_path: Path) -> None:
    capture, path = cv2.VideoCapture(str(video)), tmp_path / "blurred.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), RATE_HZ, (WIDTH, HEIGHT))
    usual = [frame.number for frame in chosen_frames(video, 0.8)][1]
    number = 0
    while (read := capture.read())[0]:
        writer.write(cv2.GaussianBlur(read[1], (0, 0), 2.5) if number == usual else read[1])
        number += 1
    writer.release()
    sharp = [frame.number for frame in chosen_frames(path, 0.8)][1]
    assert sharp != usual
    assert 1.0 - place_px(sharp) / WIDTH == pytest.approx(0.81, abs=0.035)


def test_what_two_pictures_share() -> None:
    shift = np.array([[1.0, 0.0, -80.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    assert shared(shift, 320, 240) == pytest.approx(0.75)
    zoom = np.diag([2.0, 2.0, 1.0])
    assert shared(zoom, 320, 240) == pytest.approx(0.25)
    assert shared(np.linalg.inv(zoom), 320, 240) == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("row", "height_m"),
    [
        ("[iso: 100] [latitude: 47.{k}] [longitude: 8.5] [rel_alt: 20.100 abs_alt: 450.250]", 450.25),
        ("[iso : 110] [latitude : 47.{k}] [longtitude : 8.5] [altitude: 450.25]", 450.25),
        ("HOME(8.4,46.9) 2017.08.05 14:11:51\nGPS(8.5,47.{k},16) BAROMETER:1.9", None),
    ],
)
def test_subtitles_of_dji(tmp_path: Path, row: str, height_m: float | None) -> None:
    path = tmp_path / "a.SRT"
    path.write_text(subtitles([row.replace("{k}", str(k)) for k in range(1, 4)]))
    track = read_track(path)
    place = track.at(0.5)
    assert place is not None
    assert place[:2] == pytest.approx([47.15, 8.5])
    assert np.isnan(place[2]) if height_m is None else place[2] == pytest.approx(height_m)
    assert track.at(30.0) is None


def test_subtitles_without_a_fix_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.srt"
    path.write_text(subtitles(["[latitude: 0.000000] [longitude: 0.000000] [rel_alt: 0.0 abs_alt: 0.0]"]))
    with pytest.raises(ConfigError, match="has no position with a time"):
        read_track(path)
    broken = tmp_path / "a.gpx"
    broken.write_text("<gpx><trk>")
    with pytest.raises(ConfigError, match="is no GPX track"):
        read_track(broken)


GPX = """<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
<trkpt lat="47.0" lon="8.5"><ele>450.0</ele><time>2026-05-01T10:00:00Z</time></trkpt>
<trkpt lat="47.4" lon="8.5"><ele>454.0</ele><time>2026-05-01T10:00:04Z</time></trkpt>
</trkseg></trk></gpx>"""


def test_a_run_over_a_video_with_a_track(video: Path, tmp_path: Path) -> None:
    track = tmp_path / "log.gpx"
    track.write_text(GPX)
    out = tmp_path / "images"
    refused = invoke("frames", video, "--out", out, "--track", track)
    assert refused.code == 2
    assert "--start 2026-05-01T10:00:00Z" in refused.stderr
    assert not out.exists()
    made = invoke("frames", video, "--out", out, "--track", track, "--start", "2026-05-01T10:00:00Z", "--json")
    assert made.code == 0
    assert made.facts["with_position"] == made.facts["frames"] == len(list(out.glob("*.jpg")))
    rows = read_pose_file(out / "poses.csv").rows
    for row in rows:
        number = int(row.image.removesuffix(".jpg").rpartition("_")[2])
        assert row.position == pytest.approx((47.0 + 0.1 * number / RATE_HZ, 8.5, 450.0 + number / RATE_HZ), abs=1e-3)
    again = invoke("frames", video, "--out", out)
    assert again.code == 2
    assert "is not replaced" in again.stderr


def test_subtitles_beside_the_video_are_found_and_a_video_without_has_no_poses(video: Path, tmp_path: Path) -> None:
    assert track_beside(video) is None
    made = invoke("frames", video, "--out", tmp_path / "images", "--overlap", "0.6")
    assert made.code == 0
    assert "no DJI_0001.SRT or DJI_0001.GPX lies beside the video" in made.stdout
    assert not (tmp_path / "images" / "poses.csv").exists()
    copy = tmp_path / video.name
    copy.write_bytes(video.read_bytes())
    (tmp_path / "DJI_0001.SRT").write_text("")
    assert track_beside(copy) == tmp_path / "DJI_0001.SRT"


@pytest.mark.parametrize(
    ("options", "words"), [(["--overlap", "1.2"], "between 0.3 and 0.95"), ([], "cannot be read as a video")]
)
def test_what_cannot_be_is_refused(tmp_path: Path, options: list[str], words: str) -> None:
    video = tmp_path / "a.mp4"
    video.write_bytes(b"no video")
    refused = invoke("frames", video, "--out", tmp_path / "images", *options)
    assert refused.code == 2
    assert words in refused.stderr
    assert not (tmp_path / "images").exists()
    missing = invoke("frames", tmp_path / "none.mp4", "--out", tmp_path / "images")
    assert missing.code == 2


def test_frames_without_a_place_have_empty_cells() -> None:
    text = poses_text(["a.jpg", "b.jpg", "c.jpg"], [np.array([47.0, 8.5, np.nan]), None, np.array([47.0, 8.5, 1.0])])
    assert text.splitlines()[1:] == ["a.jpg,47.00000000,8.50000000,", "b.jpg,,,", "c.jpg,47.00000000,8.50000000,1.000"]
