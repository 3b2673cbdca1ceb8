"""The stage refine run again: what is measured anew, and that it ends alike."""

from __future__ import annotations

import shutil
from typing import Any

import pytest
from conftest import IMAGES, UNORIENTED, Site
from numpy.typing import NDArray

from aeromatch_cli.data import BoolArray
from aeromatch_cli.errors import ItemError
from aeromatch_cli.images.source import Source, read_source
from aeromatch_cli.stages import measuring, refine
from aeromatch_cli.stages.context import Context
from aeromatch_cli.stages.run import FUNCTIONS
from aeromatch_cli.stages.stage_report import StageReport
from aeromatch_cli.workspace import Workspace


@pytest.mark.slow
def test_what_lacked_a_picture_is_made_again_when_it_is_back(done_site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    work = Workspace(done_site.work)
    kept = [work.adjusted, work.dropped, *sorted(work.refined("").parent.glob("*.npz"))]
    before = {path: path.read_bytes() for path in kept if path.is_file()}
    name = done_site.names()[1]

    def unreadable(source: Source, *, colour: bool) -> tuple[NDArray[Any], BoolArray | None]:
        if source.path.name == name:
            raise ItemError(f"image {name} cannot be read")
        return read_source(source, colour=colour)

    with monkeypatch.context() as patch:
        patch.setattr(refine, "read_source", unreadable)
        patch.setattr(measuring, "read_source", unreadable)
        outcome = done_site("adjust", "--overwrite", "--executor", "serial")
        assert outcome.code == 1
        made = {path: path.stat().st_mtime_ns for path in (work.adjusted, work.stage_report("refine"))}
        again = done_site("adjust", "--executor", "serial")
        # What can be made without it is not made again.
        assert again.code == 1
        assert "cannot be read" in (work.failures).read_text()
        assert {path: path.stat().st_mtime_ns for path in made} == made
    assert work.adjusted.read_bytes() != before[work.adjusted]
    assert done_site("adjust").code == 0
    assert "cannot be read" not in (work.failures).read_text()
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.slow
def test_a_picture_that_is_another_for_a_while_is_not_measured(
    done_site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is back, with its old time, when the stage has ended."""
    work = Workspace(done_site.work)
    before = _files(work)
    image, other, aside = done_site.image(1), done_site.image(2), done_site.root / "aside.jpg"
    run = refine.run

    def swapped(context: Context) -> StageReport:
        shutil.copy2(image, aside)
        shutil.copy(other, image)
        try:
            return run(context)
        finally:
            aside.replace(image)

    shutil.rmtree(work.refined("").parent)
    with monkeypatch.context() as patch:
        patch.setitem(FUNCTIONS, "refine", swapped)
        outcome = done_site("adjust")
    assert outcome.code == 1
    assert f"{image.name} has changed since the command began" in outcome.stderr
    assert done_site("adjust").code == 0
    assert _files(work) == before


@pytest.mark.slow
def test_images_measured_in_parts_are_measured_alike(done_site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    work = Workspace(done_site.work)
    before = _files(work)
    monkeypatch.setattr(refine, "_IMAGES_AT_ONCE", 2)
    assert done_site("adjust", "--overwrite", "--executor", "serial").code == 0
    assert _files(work) == before


def _files(work: Workspace) -> dict[str, bytes]:
    folder = work.refined("").parent
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.slow
def test_a_stage_that_was_stopped_goes_on_and_ends_alike(done_site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was measured before is not measured again."""
    work = Workspace(done_site.work)
    before = _files(work)
    names = sorted(path.stem for path in work.measured("").parent.glob("*.npz"))
    assert len(names) >= IMAGES - 1  # nothing measures an image all of whose keypoints stand for their points
    work.stage_report("refine").unlink()
    for name in names[2:]:
        work.measured(name).unlink()
    measured: list[str] = []

    def spied(task: measuring.MeasureTask) -> measuring.Measured:
        measured.append(task.image_id)
        return measuring.measure(task)

    monkeypatch.setattr(refine, "measure", spied)
    assert done_site("adjust", "--executor", "serial").code == 0
    assert sorted(measured) == names[2:]
    assert _files(work) == before
    # A file that does not hold what it should is no reason to stop, nor to believe it.
    damaged = work.measured(names[0])
    damaged.write_bytes(damaged.read_bytes()[:-30])
    work.stage_report("refine").unlink()
    measured.clear()
    assert done_site("adjust", "--executor", "serial").code == 0
    assert measured == names[:1]
    assert _files(work) == before


@pytest.mark.slow
def test_a_further_image_has_its_neighbours_measured_anew(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    chain = (*UNORIENTED, "--set", "pairs=sequential", "--set", "pairs.window=1", "--executor", "serial")
    last = site.image(-1)
    away = site.root / last.name
    last.rename(away)
    assert site("run", *chain).code == 0
    away.rename(last)
    measured: list[str] = []

    def spied(task: measuring.MeasureTask) -> measuring.Measured:
        measured.append(task.image_id)
        return measuring.measure(task)

    monkeypatch.setattr(refine, "measure", spied)
    assert site("run", *chain).code == 0
    ids = [name.replace(".", "_") for name in site.names()]
    # Other keypoints may stand for the points that the new image sees, too: no further than along these points.
    assert set(measured) & {ids[-1], ids[-2]}
    assert ids[0] not in measured
    before = _files(Workspace(site.work))
    assert site("adjust", *chain, "--overwrite").code == 0
    assert _files(Workspace(site.work)) == before
