from __future__ import annotations

import io
import struct
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from make_images import write_image, write_jpeg_2000
from numpy.typing import NDArray
from PIL import Image as Picture
from PIL.PngImagePlugin import PngImageFile, PngInfo

from aeromatch_cli.blocks.exif import exif_or_reason
from aeromatch_cli.blocks.packets import png_packets
from aeromatch_cli.blocks.scan import scan_images
from aeromatch_cli.data import Camera, Pose
from aeromatch_cli.errors import ItemError
from aeromatch_cli.geometry.cameras import normalise
from aeromatch_cli.geometry.rotations import from_omega_phi_kappa
from aeromatch_cli.images import heif
from aeromatch_cli.images.files import read_mask, read_pixels, write_png
from aeromatch_cli.images.masks import below_horizon, mask_path, sees_sky
from aeromatch_cli.images.scaling import shrink, shrink_camera

PINHOLE = Camera("PINHOLE", 640, 480, (700.0, 700.0, 319.5, 239.5))
LENS = Camera("OPENCV", 640, 480, (560.0, 555.0, 323.2, 231.1, -0.08, 0.03, 1e-3, -5e-4))
GROUND_Z = 12.0


def pattern(height: int = 30, width: int = 40) -> NDArray[np.uint8]:
    """No symmetry: turned, mirrored or with other colour order it is another picture."""
    y, x = np.mgrid[:height, :width]
    return np.stack([6 * x, 8 * y, 3 * x + 4 * y], axis=2).astype(np.uint8)


def encode_jpeg(pixels: NDArray[np.uint8], **options: object) -> bytes:
    stream = io.BytesIO()
    Picture.fromarray(pixels).save(stream, format="JPEG", quality=95, subsampling=0, **options)
    return stream.getvalue()


def write_tiff(path: Path, bands: NDArray[np.generic]) -> Path:
    import warnings

    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        count, height, width = bands.shape
        with rasterio.open(
            path, "w", driver="GTiff", count=count, height=height, width=width, dtype=bands.dtype
        ) as sink:
            sink.write(bands)
    return path


# --- reading --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize("colour", [True, False])
def test_orientation_never_changes_pixels(tmp_path: Path, suffix: str, colour: bool) -> None:
    found = []
    for orientation in (1, 3, 6, 8):
        tags = Picture.Exif()
        tags[0x0112] = orientation
        path = tmp_path / f"{orientation}.{suffix}"
        Picture.fromarray(pattern()).save(path, exif=tags)
        found.append(read_pixels(path, colour=colour))
    assert found[0].shape[:2] == (30, 40)
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


def test_colours_come_in_rgb_order(tmp_path: Path) -> None:
    Picture.fromarray(pattern()).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png", colour=True), pattern())
    (tmp_path / "a.jpg").write_bytes(encode_jpeg(np.full((16, 16, 3), (200, 100, 20), np.uint8)))
    assert np.abs(read_pixels(tmp_path / "a.jpg", colour=True).mean(axis=(0, 1)) - (200, 100, 20)).max() < 2
    write_tiff(tmp_path / "a.tif", np.moveaxis(pattern(), 2, 0))
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.tif", colour=True), pattern())


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif"])
def test_gray_is_the_luma_of_the_colours(tmp_path: Path, name: str) -> None:
    colours = np.full((16, 16, 3), (200, 100, 20), np.uint8)
    if name.endswith("tif"):
        write_tiff(tmp_path / name, np.moveaxis(colours, 2, 0))
    else:
        Picture.fromarray(colours).save(tmp_path / name, quality=100)
    gray = read_pixels(tmp_path / name, colour=False)
    assert (gray.dtype, gray.shape) == (np.uint8, (16, 16))
    assert abs(float(gray.mean()) - (0.299 * 200 + 0.587 * 100 + 0.114 * 20)) < 1.5


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_16_bits_are_stretched_not_cast(tmp_path: Path, suffix: str) -> None:
    """A 12-bit ramp 300..1299: percentile 0.5 is 304.995, 99.5 is 1294.005; the value in the middle becomes 127.5."""
    ramp = np.arange(300, 1300, dtype=np.uint16).reshape(20, 50)
    path = tmp_path / f"a.{suffix}"
    if suffix == "tif":
        write_tiff(path, ramp[None])
    else:
        cv2.imwrite(str(path), ramp)
    gray = read_pixels(path, colour=False)
    expected = np.clip(np.rint((ramp - 304.995) * 255.0 / (1294.005 - 304.995)), 0, 255)
    assert np.abs(gray.astype(int) - expected).max() <= 1
    assert (gray.min(), gray.max()) == (0, 255)
    assert read_pixels(path, colour=True).dtype == np.uint16
    np.testing.assert_array_equal(read_pixels(path, colour=True), ramp)


def test_bands_beyond_three_are_left_out(tmp_path: Path) -> None:
    bands = np.concatenate([np.moveaxis(pattern(), 2, 0), np.full((1, 30, 40), 255, np.uint8)])
    np.testing.assert_array_equal(read_pixels(write_tiff(tmp_path / "4.tif", bands), colour=True), pattern())
    two = read_pixels(write_tiff(tmp_path / "2.tif", bands[:2]), colour=True)
    np.testing.assert_array_equal(two, pattern()[..., 0])
    Picture.fromarray(np.dstack([pattern(), np.full((30, 40), 9, np.uint8)])).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png", colour=True), pattern())


def test_gray_files_stay_gray(tmp_path: Path) -> None:
    gray = pattern()[..., 0]
    Picture.fromarray(gray).save(tmp_path / "a.png")
    for colour in (True, False):
        np.testing.assert_array_equal(read_pixels(tmp_path / "a.png", colour=colour), gray)


def test_cut_jpegs_are_refused_wherever_they_are_cut(tmp_path: Path) -> None:
    """Also with a thumbnail in the header, which has an end marker of its own."""
    rng = np.random.default_rng(0)
    thumbnail = encode_jpeg(pattern())
    noise = rng.integers(0, 256, (200, 200, 3), dtype=np.uint8)
    whole = encode_jpeg(noise, exif=b"Exif\x00\x00" + thumbnail)
    assert whole.count(b"\xff\xd9") == 2
    path = tmp_path / "a.jpg"
    path.write_bytes(whole)
    assert read_pixels(path, colour=False).shape == (200, 200)
    for share in (0.3, 0.6, 0.9, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ItemError, match=r"cut off|cannot decode"):
            read_pixels(path, colour=False)


def test_jpegs_with_data_behind_their_end_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(encode_jpeg(pattern()) + bytes(200_000))
    assert read_pixels(path, colour=False).shape == (30, 40)


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif"])
@pytest.mark.parametrize("data", [b"", b"\xff\xd8\xff\xe0", b"no picture at all" * 50, None])
def test_what_is_no_picture_is_an_item_error(tmp_path: Path, name: str, data: bytes | None) -> None:
    path = tmp_path / name
    if data is None:
        path.mkdir()
    else:
        path.write_bytes(data)
    with pytest.raises(ItemError, match=name.replace(".", r"\.")):
        read_pixels(path, colour=False)
    with pytest.raises(ItemError, match="gone"):
        read_pixels(tmp_path / f"gone{path.suffix}", colour=True)


def test_a_cut_tiff_is_an_item_error(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.tif", (400, 300))
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(ItemError):
        read_pixels(path, colour=False)


@pytest.mark.parametrize("pixels", [pattern(), pattern()[..., 0], pattern().astype(np.uint16) * 257])
def test_png_round_trip(tmp_path: Path, pixels: NDArray[np.generic]) -> None:
    with (tmp_path / "a.png").open("wb") as stream:
        write_png(stream, pixels)
    np.testing.assert_array_equal(read_pixels(tmp_path / "a.png", colour=True), pixels)


def test_heic_by_pillow_heif(tmp_path: Path) -> None:
    """Pixels, tags and XMP; without the package the message says what to install."""
    pytest.importorskip("pillow_heif")
    assert heif.readable()
    tags = Picture.Exif()
    tags[272], tags[274] = "Model", 1
    colours = np.zeros((48, 64, 3), np.uint8)
    colours[:, :32], colours[:, 32:] = (200, 30, 10), (10, 30, 200)
    space = 'xmlns:d="http://www.dji.com/drone-dji/1.0/"'
    xmp = f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><a {space} d:RelativeAltitude="40"/></x:xmpmeta>'
    path = tmp_path / "a.HEIC"
    Picture.fromarray(colours).save(path, format="HEIF", exif=tags.tobytes(), xmp=xmp.encode(), quality=95)
    pixels = read_pixels(path, colour=True)
    assert np.abs(pixels.astype(int) - colours).mean() < 3.0
    assert read_pixels(path, colour=False).shape == (48, 64)
    facts = exif_or_reason(path)
    assert not isinstance(facts, str)
    assert (facts.width_px, facts.height_px, facts.model, facts.relative_altitude_m) == (64, 48, "Model", 40.0)
    assert scan_images(tmp_path) == (["a.HEIC"], [])
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(ItemError, match=r"a\.HEIC"):
        read_pixels(path, colour=True)


def test_heic_without_pillow_heif(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(heif, "readable", lambda: False)
    (tmp_path / "a.heic").write_bytes(b"x")
    with pytest.raises(ItemError, match=r"pip install 'aeromatch\[heif\]' reads it"):
        read_pixels(tmp_path / "a.heic", colour=True)


# --- masks ----------------------------------------------------------------------------------------------------------


def test_mask_names(tmp_path: Path) -> None:
    for name in ("a/1.jpg.png", "a/2.png", "b/1.jpg.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    masks = str(tmp_path)
    assert mask_path(masks, "a/1.jpg") == tmp_path / "a/1.jpg.png"
    assert mask_path(masks, "b/1.jpg") == tmp_path / "b/1.jpg.png"
    assert mask_path(masks, "a/2.jpg") == tmp_path / "a/2.png"
    assert mask_path(masks, "1.jpg") is None
    assert mask_path("", "a/1.jpg") is None
    for name in ("c/3.JPG", "c/3_mask.JPG", "c/4.jpg", "c/4.png", "c/5.jpg", "c/5.jpg.mask.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    assert mask_path(masks, "c/3.JPG") == tmp_path / "c/3_mask.JPG"
    assert mask_path(masks, "c/4.jpg") is None  # images and masks share a folder: c/4.png is another image
    assert mask_path(masks, "c/4.png") is None
    assert mask_path(masks, "c/5.jpg") == tmp_path / "c/5.jpg.mask.png"
    one = str(tmp_path / "a/2.png")
    assert mask_path(one, "a/1.jpg") == mask_path(one, "z.tif") == tmp_path / "a/2.png"


def test_masks_of_another_size_are_fitted(tmp_path: Path) -> None:
    mask = np.zeros((2, 4), np.uint8)
    mask[0, :2] = 255
    mask[1, 3] = 1
    Picture.fromarray(mask).save(tmp_path / "m.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png", 4, 2), mask > 0)
    found = read_mask(tmp_path / "m.png", 40, 20)
    np.testing.assert_array_equal(found, np.kron(mask > 0, np.ones((10, 10), bool)))
    (tmp_path / "bad.png").write_bytes(b"x")
    with pytest.raises(ItemError, match="bad"):
        read_mask(tmp_path / "bad.png", 4, 2)
    assert read_mask(tmp_path / "m.png", 401, 200).shape == (200, 401)  # reduced, and rounded
    with pytest.raises(ItemError, match=r"m\.png is 4 x 2 pixels, its image 20 x 40, another shape"):
        read_mask(tmp_path / "m.png", 20, 40)


def test_frames_of_zeros_are_masked_and_black_objects_are_not() -> None:
    from aeromatch_cli.images.masks import without_frames

    pixels = np.full((60, 80), 100, np.uint8)
    pixels[20:30, 20:30] = 0
    assert without_frames(pixels) is None
    pixels[:, :10] = 0
    valid = without_frames(pixels)
    assert valid is not None
    expected = np.ones((60, 80), bool)
    expected[:, :10] = False
    np.testing.assert_array_equal(valid, expected)
    noise = np.where(np.random.default_rng(1).random((60, 80)) < 0.6, 0, 100).astype(np.uint8)
    _, numbers = cv2.connectedComponents((noise == 0).astype(np.uint8), connectivity=4)
    edge = np.concatenate([numbers[0], numbers[-1], numbers[:, 0], numbers[:, -1]])
    np.testing.assert_array_equal(without_frames(noise), ~np.isin(numbers, edge[edge > 0]))
    assert not without_frames(noise).all()


# --- sky ------------------------------------------------------------------------------------------------------------


def test_sky_begins_at_the_horizon_row() -> None:
    """Axis 10 degrees below the horizon: the horizon is f tan 10 deg above the principal point."""
    attitude = from_omega_phi_kappa(80.0, 0.0, 0.0)
    horizon = 239.5 - 700.0 * np.tan(np.radians(10.0))  # row 116.07
    mask = below_horizon(PINHOLE, attitude)
    assert mask.shape == (480, 640)
    assert not mask[: int(np.floor(horizon))].any()
    assert mask[int(np.ceil(horizon)) :].all()
    pose = Pose(np.zeros(3), attitude, 1.0, 1.0)
    assert sees_sky(PINHOLE, pose)
    assert not sees_sky(PINHOLE, Pose(np.zeros(3), from_omega_phi_kappa(60.0, 0.0, 0.0), 1.0, 1.0))
    assert not sees_sky(PINHOLE, Pose(np.zeros(3), None, 1.0, 1.0))
    assert not sees_sky(PINHOLE, None)


def test_sky_agrees_with_every_single_ray() -> None:
    attitude = from_omega_phi_kappa(75.0, 12.0, 33.0)
    rows, columns = np.mgrid[:480:7, :640:7]
    rays = normalise(LENS, np.stack([columns.ravel(), rows.ravel()], axis=1))
    up = (np.column_stack([rays, np.ones(len(rays))]) @ attitude)[:, 2]
    mask = below_horizon(LENS, attitude)[rows.ravel(), columns.ravel()]
    clear = np.abs(up) > 2e-4  # a fifth of a pixel on either side of the horizon is left to rounding
    np.testing.assert_array_equal(mask[clear], up[clear] < 0)
    assert 0.05 < mask.mean() < 0.95


# --- shrinking ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("width", "height", "scale"), [(101, 67, 0.5), (100, 66, 0.36550), (640, 427, 0.3), (99, 99, 0.99)]
)
def test_shrinking_keeps_half_pixels_exact(width: int, height: int, scale: float) -> None:
    """A ramp tells for every reduced pixel which source place it shows: (x + 0.5) / scale - 0.5, to the last row."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    small_x, small_y = shrink(x, scale), shrink(y, scale)
    camera = shrink_camera(Camera("PINHOLE", width, height, (500.0, 500.0, 40.0, 30.0)), scale)
    assert small_x.shape == (camera.height_px, camera.width_px)
    # The area filter itself is off by up to 0.04 px; the last pixel may hang over the edge.
    rows, columns = np.mgrid[: camera.height_px - 1, : camera.width_px - 1]
    np.testing.assert_allclose(small_x[:-1, :-1], (columns + 0.5) / scale - 0.5, atol=0.04)
    np.testing.assert_allclose(small_y[:-1, :-1], (rows + 0.5) / scale - 0.5, atol=0.04)
    np.testing.assert_allclose(camera.params, (500 * scale, 500 * scale, 40.5 * scale - 0.5, 30.5 * scale - 0.5))


def test_nothing_is_shrunk_at_full_scale_or_below_one_pixel() -> None:
    pixels = pattern()
    assert shrink(pixels, 1.0) is pixels
    assert shrink_camera(PINHOLE, 1.0) is PINHOLE
    assert shrink(pixels, 1e-4).shape == (1, 1, 3)


# --- hostile files ----------------------------------------------------------------------------------------------------


def _claiming(path: Path, width: int, height: int) -> Path:
    """A PNG of some bytes whose header states a size."""
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(b"\0" * 100)) + chunk(b"IEND", b""))
    return path


def test_a_file_that_claims_a_huge_picture_is_refused_before_it_is_decoded(tmp_path: Path) -> None:
    path = _claiming(tmp_path / "bomb.png", 60_000, 60_000)
    with pytest.raises(ItemError, match="has 3,600 megapixels; more than 1,074 are not decoded"):
        read_pixels(path, colour=False)
    assert "3,600 megapixels" in str(exif_or_reason(path))
    with pytest.raises(ItemError, match="3,600 megapixels"):
        read_mask(path, 40, 30)
    # A mapping camera's frame is no such thing: it is cut off, and the decoder says so.
    with pytest.raises(ItemError, match="cannot decode"):
        read_pixels(_claiming(tmp_path / "large.png", 26_460, 17_004), colour=False)


def test_a_png_chunk_that_claims_more_than_the_file_holds_is_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Picture.fromarray(pattern()).save(path)
    data = path.read_bytes()
    path.write_bytes(data + b"appended")  # behind the end anything may stand
    np.testing.assert_array_equal(read_pixels(path, colour=True), pattern())
    place = data.index(b"IDAT") - 4
    for length in (0x7FFF_FFFF, len(data)):
        path.write_bytes(data[:place] + length.to_bytes(4, "big") + data[place + 4 :])
        before = time.process_time()
        with pytest.raises(ItemError, match=r"a\.png is cut off: its PNG data ends early; copy it again or remove it"):
            read_pixels(path, colour=True)
        assert time.process_time() - before < 0.5  # OpenCV alone takes seconds


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_jpeg_2000_that_is_cut_off_is_refused(tmp_path: Path, share: float) -> None:
    bands = np.random.default_rng(0).integers(0, 4096, (3, 600, 700)).astype(np.uint16)
    path = write_jpeg_2000(tmp_path / "a.jp2", bands)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(ItemError, match=r"a\.jp2"):
        read_pixels(path, colour=True)


def test_tags_behind_the_pixels_of_a_png_are_read_without_decoding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tags, packet = Picture.Exif(), PngInfo()
    tags[272] = "Model X"
    packet.add_itxt("XML:com.adobe.xmp", '<x:xmpmeta xmlns:x="adobe:ns:meta/"/>')
    path = tmp_path / "a.png"
    Picture.fromarray(pattern()).save(path, exif=tags, pnginfo=packet)
    data, chunks, at = path.read_bytes(), [], 8
    while at < len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        chunks.append((kind, data[at : at + 12 + length]))
        at += 12 + length
    late = (b"eXIf", b"iTXt", b"IEND")
    parts = [chunk for kind, chunk in chunks if kind not in late] + [chunk for kind, chunk in chunks if kind in late]
    path.write_bytes(data[:8] + b"".join(parts))
    monkeypatch.setattr(PngImageFile, "load", None)
    facts = exif_or_reason(path)
    assert not isinstance(facts, str)
    assert facts.model == "Model X"
    assert png_packets(path).xmp[0].startswith(b"<x:xmpmeta")
    plain = exif_or_reason(_claiming(tmp_path / "plain.png", 20_000, 20_000))
    assert not isinstance(plain, str)
    assert (plain.width_px, plain.model) == (20_000, "")
