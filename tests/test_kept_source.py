"""Pictures beside those that were taken: which images get them, what stays on file, and the preset that uses them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from conftest import PAGE, QUICK, UNORIENTED, Site, invoke
from PIL import Image

from aeromatch_cli.config.text import default_yaml
from aeromatch_cli.files import read_json
from aeromatch_cli.formats.features import read_features

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("arms")]
SETTINGS = UNORIENTED

BESIDE = ("--set", "enhance=clahe", "--set", "enhance.keep_source=true")
_EXIF_IFD, _DATE_TIME_ORIGINAL = 0x8769, 36867


def take_at(site: Site, clock: Callable[[int], str]) -> None:
    """Write capture times "HH:MM:SS" by the number of the image in the order of names."""
    for number, name in enumerate(site.names()):
        path = site.images / name
        with Image.open(path) as picture:
            tags = picture.getexif()
            tags.get_ifd(_EXIF_IFD)[_DATE_TIME_ORIGINAL] = f"2024:06:21 {clock(number)}"
            picture.save(path, exif=tags)


def enhanced_views(site: Site) -> dict[str, bool]:
    """By image id: whether its features come from an enhanced picture too."""
    features = {path.stem: read_features(path) for path in (site.work / "features").glob("*.npz")}
    return {image_id: bool(found.view_enhanced.any()) for image_id, found in features.items()}


def test_without_capture_times_every_image_has_both_pictures(site: Site) -> None:
    assert site("extract", *BESIDE).code == 0
    assert set(enhanced_views(site).values()) == {True}
    budget = next(float(value) for key, _, value in (o.partition("=") for o in QUICK) if key == "extract.keypoints")
    for path in (site.work / "features").glob("*.npz"):
        found = read_features(path)
        of_enhanced = found.view_enhanced[found.view_idx]
        assert len(of_enhanced) == 2 * (~of_enhanced).sum() == 2 * budget  # as many descriptors in either


def test_images_of_one_sun_are_left_as_they_are(site: Site) -> None:
    take_at(site, lambda number: f"12:{5 * number:02d}:00")  # five images within 20 minutes
    assert site("extract", *BESIDE).code == 0
    assert set(enhanced_views(site).values()) == {False}
    alone = site.another_workspace("alone")
    assert site("extract", "--workspace", alone).code == 0
    for path in sorted((site.work / "features").glob("*.npz")):
        skipped, plain = read_features(path), read_features(alone / "features" / path.name)
        assert np.array_equal(skipped.keypoints_px, plain.keypoints_px)
        assert np.array_equal(skipped.descriptors, plain.descriptors)


def test_without_keep_source_the_time_has_no_effect(site: Site) -> None:
    take_at(site, lambda _: "12:00:00")
    clahe = ("--set", "enhance=clahe", "--set", "enhance.same_illumination_minutes=20")
    outcome = site("enhance", *clahe)
    assert outcome.counts("enhance") == (5, 0, 0)
    assert "same illumination" not in outcome.stdout
    described = " ".join(default_yaml().replace("#", "").split())
    assert "With keep_source: an image is not enhanced if all images" in described


def test_only_images_with_a_partner_of_another_time_are_enhanced(site: Site) -> None:
    take_at(site, lambda number: "12:00:00" if number else "12:21:00")
    chained = (*BESIDE, "--set", "pairs=sequential", "--set", "pairs.window=1")
    assert site("extract", *chained).code == 0
    assert [both for _, both in sorted(enhanced_views(site).items())] == [True, True, False, False, False]
    assert site("extract", *chained, "--set", "enhance.same_illumination_minutes=21").code == 0
    assert set(enhanced_views(site).values()) == {False}


def test_skipped_images_have_no_enhanced_picture_and_are_counted(site: Site) -> None:
    take_at(site, lambda number: "12:00:00" if number else "12:21:00")
    chained = (*BESIDE, "--set", "pairs=sequential", "--set", "pairs.window=1")
    said = "3 images not enhanced (skipped: same illumination)"

    def pictures() -> list[str]:
        return sorted(path.stem for path in site.work.glob("enhanced/*.png"))

    ids = [name.replace(".", "_") for name in site.names()]
    outcome = site("enhance", *chained)
    assert outcome.counts("enhance") == (2, 3, 0)
    assert said in outcome.stdout
    assert pictures() == ids[:2]
    assert site("enhance", *chained).counts("enhance") == (0, 5, 0)
    for _ in range(2):  # the second time it is up to date
        outcome = site("run", *chained, "--keep-images", *PAGE)
        assert said in outcome.stdout
        assert pictures() == ids[:2]
    facts = read_json(site.work / "reports" / "extract.json")["result"]
    assert facts["images_skipped_same_illumination"] == 3
    assert "3 images not enhanced (same illumination)" in (site.work / "report" / "index.html").read_text(
        encoding="utf-8"
    )
    # Enhanced once, skipped now: nobody is to take the picture for one that is used.
    assert site("enhance", *chained, "--set", "enhance.same_illumination_minutes=0").counts("enhance") == (5, 0, 0)
    assert pictures() == ids
    assert site("enhance", *chained).counts("enhance") == (2, 3, 0)
    assert pictures() == ids[:2]


def test_preset_fusion_verifies_the_block(site: Site) -> None:
    outcome = invoke("run", "fusion", *site.options("--json", *PAGE))
    assert outcome.code == 0
    assert True in enhanced_views(site).values()
    report = read_json(site.work / "reports" / "filter.json")
    assert report["result"]["pairs"] == {"verified": 10}
    assert (site.work / "export" / "colmap" / "database.db").is_file()
    shown = (site.work / "report" / "index.html").read_text(encoding="utf-8")
    assert "Shadow %" in shown
