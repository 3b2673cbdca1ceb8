"""Blurred, black and white pictures are named, sharp ones of anything are not; --exclude leaves images out."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import Site
from numpy.typing import NDArray

from aeromatch_cli.blocks.doubles import thumbnails
from aeromatch_cli.blocks.left_out import excluded
from aeromatch_cli.data import Image, PictureQuality
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.formats.tables import images_text, read_picture_quality
from aeromatch_cli.images.sharpness import picture_quality, read_quality, shows_nothing, unsharp

SIDE = 256
RNG = np.random.default_rng(7)


def fractal(exponent: float, contrast: float) -> NDArray[np.float64]:
    """Texture whose amplitudes fall with the frequency to a power: 1 is that of most ground, more of smoother one."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(SIDE), np.fft.fftfreq(SIDE)))
    frequency[0, 0] = 1.0
    noise = np.fft.fft2(RNG.normal(size=(SIDE, SIDE)))
    picture = np.fft.ifft2(noise / frequency**exponent).real
    return 120.0 + contrast * (picture - picture.mean()) / picture.std()


def grass() -> NDArray[np.float64]:
    return fractal(0.8, 25.0)


def water() -> NDArray[np.float64]:
    """Smooth, of hardly any contrast but for the sensor's noise and some glints."""
    picture = fractal(1.6, 6.0)
    picture[RNG.random((SIDE, SIDE)) < 0.002] += 60.0
    return picture


def roofs() -> NDArray[np.float64]:
    picture = fractal(1.0, 8.0)
    for _ in range(40):
        x, y = RNG.integers(0, SIDE, 2)
        w, h = RNG.integers(10, 60, 2)
        picture[y : y + h, x : x + w] = RNG.uniform(40.0, 220.0) + 0.3 * (picture[y : y + h, x : x + w] - 120.0)
    return picture


def taken(scene: NDArray[np.float64], sigma_px: float = 0.0) -> NDArray[np.uint8]:
    """A picture of a scene: the lens, then the sensor's noise, then JPEG."""
    seen = cv2.GaussianBlur(scene, (0, 0), float(np.hypot(0.5, sigma_px))) + RNG.normal(0.0, 1.0, scene.shape)
    stored = cv2.imencode(".jpg", np.clip(seen, 0.0, 255.0).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
    return np.asarray(cv2.imdecode(stored, cv2.IMREAD_GRAYSCALE))


def blur_of(picture: NDArray[np.uint8]) -> float:
    return picture_quality(picture, None).blur


SCENES = (grass, water, roofs)


@pytest.mark.parametrize("scene", [grass, roofs], ids=lambda scene: scene.__name__)
def test_blur_grows_with_what_blurs_and_hardly_depends_on_contrast(scene) -> None:
    one = scene()
    found = [blur_of(taken(one, sigma_px)) for sigma_px in (0.0, 1.0, 2.5)]
    assert found == sorted(found)
    dim = np.clip(60.0 + 0.5 * taken(one).astype(float), 0.0, 255.0).astype(np.uint8)
    assert blur_of(dim) == pytest.approx(found[0], abs=0.05)


def test_of_sharp_pictures_of_different_things_none_is_named() -> None:
    blurs = [blur_of(taken(SCENES[k % 3]())) for k in range(18)]
    assert unsharp(blurs) == []
    assert unsharp(sorted(blurs)) == []
    assert unsharp([blur_of(taken(scene())) for scene in SCENES for _ in range(6)]) == []


@pytest.mark.parametrize("scene", [grass, roofs], ids=lambda scene: scene.__name__)
def test_a_blurred_picture_and_a_run_of_them_are_named(scene) -> None:
    blurs = [blur_of(taken(scene(), 2.5 if k in (4, 9, 10, 11) else 0.0)) for k in range(18)]
    assert unsharp(blurs) == [4, 9, 10, 11]


def test_motion_in_one_direction_is_blur() -> None:
    one = grass()
    kernel = np.full((1, 11), 1.0 / 11.0)
    assert blur_of(taken(cv2.filter2D(one, -1, kernel))) > blur_of(taken(one)) + 0.2


def test_few_pictures_tell_nothing_and_unknown_ones_are_passed_over() -> None:
    assert unsharp([0.2, 0.2, 0.2, 0.8]) == []
    assert unsharp([0.2, float("nan"), 0.2, 0.2, 0.8, 0.2, 0.2]) == [4]


def test_black_and_white_pictures_show_nothing() -> None:
    black = np.clip(RNG.normal(4.0, 2.0, (60, 80)), 0, 255).astype(np.uint8)
    assert [shows_nothing(picture_quality(one, None)) for one in (black, 255 - black, taken(roofs()))] == [
        "black",
        "white",
        "",
    ]
    masked = np.vstack([black, taken(grass())[:60, :80]])
    valid = np.repeat([False, True], 60)[:, None] & np.ones((120, 80), dtype=bool)
    assert shows_nothing(picture_quality(masked, valid)) == ""
    assert np.isnan(picture_quality(black, np.zeros((60, 80), dtype=bool)).blur)


@pytest.mark.parametrize(
    ("value", "figures", "nothing"),
    [(0, [np.nan, 1.0, 0.0], "black"), (255, [1.0, 0.0, 1.0], "white"), (128, [1.0, 0.0, 0.0], "without texture")],
)
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_a_picture_of_one_value_shows_nothing(
    tmp_path: Path, value: int, figures: list[float], nothing: str, suffix: str
) -> None:
    path = tmp_path / f"a{suffix}"
    cv2.imwrite(str(path), np.full((60, 80, 3), value, np.uint8))
    quality = read_quality(path)
    np.testing.assert_equal(quality[:3], figures)
    assert shows_nothing(quality) == nothing


def test_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    picture = taken(grass())
    cv2.imwrite(str(path), picture)
    assert read_quality(path) == picture_quality(picture, None)


def test_figures_stand_beside_the_images(tmp_path: Path) -> None:
    images = [Image("a_jpg", "a.jpg", 80, 60, "1"), Image("b_jpg", "b.jpg", 80, 60, "1")]
    path = tmp_path / "images.csv"
    path.write_text(images_text(images, {"a_jpg": "f1", "b_jpg": "f2"}, {"a_jpg": PictureQuality(0.25, 0.5, 0.0)}))
    assert read_picture_quality(path) == {("a_jpg", "f1"): PictureQuality(0.25, 0.5, 0.0)}


NAMES = ["takeoff/DJI_0001.JPG", "flight/DJI_0001.JPG", "flight/DJI_0002.JPG", "flight/DJI_0010.JPG"]


@pytest.mark.parametrize(
    ("text", "out"),
    [
        ("", []), ("takeoff/*", [0]), ("DJI_0001.JPG", [0, 1]), ("flight/dji_0001.jpg", [1]), ("*_000?.jpg", [0, 1, 2]),
        ("flight\\DJI_0010.JPG, takeoff/*", [0, 3]),
    ],
)  # fmt: skip
def test_names_and_patterns_leave_images_out(text: str, out: list[int]) -> None:
    found, remarks = excluded(text, NAMES)
    assert sorted(found) == sorted(NAMES[k] for k in out)
    assert len(remarks) == bool(text)


def test_a_file_lists_what_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "blurred.txt"
    path.write_text("# looked at\nflight/DJI_0002.JPG,0.61\n./takeoff/*\nDJI_0099.JPG\n")
    found, remarks = excluded(str(path), NAMES)
    assert sorted(found) == [NAMES[2], NAMES[0]]
    assert remarks == [
        "2 of 4 images (flight/DJI_0002.JPG, takeoff/DJI_0001.JPG) are left out, as --exclude asks",
        "--exclude fits no image of the folder: DJI_0099.JPG",
    ]
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="give a text file of names"):
        excluded(str(path), NAMES)


def test_blurred_pictures_are_named_before_the_long_stages_and_left_out_where_asked(site: Site) -> None:
    names = site.names()
    path = site.images / names[3]
    cv2.imwrite(str(path), cv2.GaussianBlur(cv2.imread(str(path)), (0, 0), 4.0))
    said = site("pairs", "--set", "orient=none")
    named = rf"1 of {len(names)} images \({re.escape(names[3])}: 0\.\d\d\) is far more blurred than others of the same"
    assert re.search(f"{named} camera: ", said.stderr)
    figures = read_picture_quality(site.work / "images.csv")
    assert len(figures) == len(names)
    assert max(figures, key=lambda key: figures[key].blur)[0].startswith(Path(names[3]).stem)
    said = site("pairs", "--set", "orient=none", "--exclude", names[3])
    assert f"1 of {len(names)} images ({names[3]}) is left out, as --exclude asks" in said.stderr
    assert "blurred" not in said.stderr
    assert len(read_picture_quality(site.work / "images.csv")) == len(names) - 1


def test_a_damaged_picture_is_named_once_and_not_by_the_decoder(site: Site, capfd: pytest.CaptureFixture[str]) -> None:
    path = site.images / site.names()[1]
    damaged = path.with_suffix(".jpg")
    picture = cv2.imread(str(path))
    data = bytearray(cv2.imencode(".jpg", picture)[1].tobytes())
    middle = len(data) // 2
    data[middle : middle + 300] = bytes(300)
    path.unlink()
    damaged.write_bytes(data)
    quality = read_quality(damaged)
    assert quality.damage.startswith("Corrupt JPEG data")
    assert capfd.readouterr().err == ""
    images = [Image("a_jpg", "a.jpg", 4, 3, "1", 1)]
    table = site.root / "images.csv"
    table.write_text(images_text(images, {"a_jpg": "f1"}, {"a_jpg": quality}))
    assert read_picture_quality(table)["a_jpg", "f1"].damage == quality.damage
    outcome = site("pairs", "--set", "orient=none", "--poses", "none", "--set", "pairs=exhaustive")
    said = [line for line in outcome.stderr.splitlines() if "Corrupt JPEG data" in line]
    assert len(said) == 1
    named = (
        rf"images \({re.escape(damaged.name)}: Corrupt JPEG data[^)]*\) is damaged, and partly gray or noise perhaps: "
    )
    assert re.search(named, said[0])
    sound = cv2.imencode(".jpg", picture)[1].tobytes()
    damaged.write_bytes(sound)
    assert read_quality(damaged).damage == ""


def test_small_copies_of_pictures_are_named() -> None:
    sizes = {"a.jpg": (4000, 3000), "thumbs/a.jpg": (160, 120), "b.JPG": (4000, 3000), "b_thumb.jpg": (640, 480)}
    (said,) = thumbnails(sizes)
    assert said.startswith("2 of 4 images (thumbs/a.jpg: 160 x 120, b_thumb.jpg: 640 x 480) are small copies")
    thermal = {"DJI_1_W.JPG": (4000, 3000), "DJI_1_T.JPG": (640, 512), "x/1.jpg": (640, 512), "y/1.jpg": (4000, 3000)}
    assert thumbnails(thermal) == []
    assert thumbnails({"x/1.jpg": (2000, 1500), "y/1.jpg": (4000, 3000)}) == []
