"""Writing rendered blocks: what is refused before anything is written, and how an interrupted one goes on."""

from __future__ import annotations

from pathlib import Path

import pytest

from aeromatch_cli.errors import ConfigError, WorkspaceError
from aeromatch_cli.lab.synthetic import render_block


def test_arguments_that_cannot_be_used_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(ConfigError, match=r"'villlage'.*use one of: city, suburb"):
        render_block(out, "villlage")
    with pytest.raises(ConfigError, match="images"):
        render_block(out, "city", images=0)
    with pytest.raises(ConfigError, match="16 px"):
        render_block(out, "city", width_px=8)
    with pytest.raises(ConfigError, match="seed"):
        render_block(out, "city", seed=-1)
    with pytest.raises(ConfigError, match=r"'loop'.*nadir, oblique"):
        render_block(out, "city", flight="loop")
    with pytest.raises(ConfigError, match="FISHEYE"):
        render_block(out, "city", lens="FISHEYE")
    with pytest.raises(ConfigError, match="elevation"):
        render_block(out, "city", sun_deg=(10.0, 2.0))
    with pytest.raises(ConfigError, match="flying height"):
        render_block(out, "city", height_m=0.0)
    with pytest.raises(ConfigError, match="square kilometres"):
        render_block(out, "city", height_m=10_000.0)
    with pytest.raises(ConfigError, match="seed"):
        render_block(out, "city", seed=2**40)
    assert not out.exists()


def test_folders_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(WorkspaceError, match=r"cannot be written to .*file"):
        render_block(tmp_path / "file" / "block", "grass", width_px=32, height_px=24, images=1)
    (tmp_path / "mine" / "images").mkdir(parents=True)
    (tmp_path / "mine" / "images" / "holiday.jpg").write_bytes(b"dear")
    with pytest.raises(ConfigError, match=r"holiday\.jpg"):
        render_block(tmp_path / "mine", "grass", width_px=32, height_px=24, images=1)
    assert (tmp_path / "mine" / "images" / "holiday.jpg").read_bytes() == b"dear"


def test_an_interrupted_block_goes_on_and_another_is_not_mixed_in(tmp_path: Path) -> None:
    sizes = {"width_px": 64, "height_px": 48, "images": 3}
    render_block(tmp_path, "grass", **sizes)
    whole = {p: p.read_bytes() for p in sorted(tmp_path.rglob("*")) if p.is_file()}
    (tmp_path / "truth.json").unlink()
    (tmp_path / "images" / "grass_0003.jpg").unlink()
    kept = (tmp_path / "images" / "grass_0001.jpg").stat().st_mtime_ns
    render_block(tmp_path, "grass", **sizes)
    assert {p: p.read_bytes() for p in sorted(tmp_path.rglob("*")) if p.is_file()} == whole
    assert (tmp_path / "images" / "grass_0001.jpg").stat().st_mtime_ns == kept
    for other in ({"seed": 1}, {"flight": "orbit"}, {"height_m": 70.0}, {"sun_deg": (10.0, 40.0)}):
        with pytest.raises(ConfigError, match="rendered otherwise"):
            render_block(tmp_path, "grass", **sizes, **other)
    with pytest.raises(ConfigError, match="holds no pictures"):
        render_block(tmp_path, "grass", texture=tmp_path / "nowhere", **sizes)
    assert {p: p.read_bytes() for p in sorted(tmp_path.rglob("*")) if p.is_file()} == whole
