"""Workspaces that cannot be written, are of another version or lie in an odd place: a clear message, nothing lost."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import IMAGES, UNORIENTED, Site, contents

from aeromatch_cli import workspace as workspace_module
from aeromatch_cli.files import read_json, write_atomically

pytestmark = pytest.mark.slow
SETTINGS = UNORIENTED


def test_workspace_below_a_file(site):
    (site.root / "file").write_text("")
    for place in (site.root / "file", site.root / "file" / "work"):
        outcome = site("run", "--workspace", place)
        assert (outcome.code, "a file stands where a folder is needed" in outcome.stderr) == (3, True)


def test_read_only_workspace(site, monkeypatch):
    def refuse(self, *arguments, **options):
        raise OSError(errno.EROFS, "Read-only file system", str(self))

    monkeypatch.setattr(workspace_module.Path, "touch", refuse)
    outcome = site("run")
    assert outcome.code == 3
    assert "Read-only file system" in outcome.stderr
    assert "choose another --workspace" in outcome.stderr


def test_full_disk_stops_and_resumes(done_site, monkeypatch):
    work = done_site.root / "full"
    left = [9]

    def limited(path, fill):
        def filled(stream):
            left[0] -= 1
            if left[0] < 0:
                stream.write(b"half of")
                raise OSError(errno.ENOSPC, "No space left on device")
            fill(stream)

        write_atomically(path, filled)

    for module in ("files", "stages.extract", "stages.match", "stages.filter", "stages.enhance", "stages.simulate"):
        monkeypatch.setattr(f"aeromatch_cli.{module}.write_atomically", limited)
    outcome = done_site("run", "--workspace", work)
    assert outcome.code == 3
    assert "disk full" in outcome.stderr
    assert "free space" in outcome.stderr
    assert not list(work.rglob("*.tmp"))
    monkeypatch.undo()
    outcome = done_site("run", "--workspace", work)
    assert outcome.code == 0
    assert contents(work) == contents(done_site.work)


def test_workspace_of_another_version(done_site):
    block = read_json(done_site.work / "block.json")
    (done_site.work / "block.json").write_text(json.dumps({**block, "format_version": 99}))
    before = contents(done_site.work)
    for command in ("run", "check", "pairs", "export"):
        outcome = done_site(command)
        assert outcome.code == 3
        assert "format version 99" in outcome.stderr
        assert "choose another --workspace" in outcome.stderr
    assert contents(done_site.work) == before


def test_workspace_inside_the_images_folder(site):
    inside = site.images / "work"
    assert site("run", "--keep-images", "--workspace", inside).code == 0
    assert list(inside.rglob("*.png"))
    again = site("run", "--keep-images", "--workspace", inside)
    assert (again.code, again.done()) == (0, {})
    other = site("run", "--workspace", site.root / "other")  # nor are those of another workspace
    assert other.facts["stages"]["pairs"]["result"]["images"] == IMAGES
    outcome = site("run", "--workspace", site.images)
    assert (outcome.code, "choose another --workspace" in outcome.stderr) == (2, True)


@pytest.mark.slow
def test_a_second_command_on_a_workspace_is_refused_until_the_first_ends(done_site: Site, tmp_path: Path) -> None:
    """A process that holds the workspace, and is killed: the kernel lets go."""
    holder = tmp_path / "hold.py"
    holder.write_text(
        "import sys, time\nfrom pathlib import Path\nfrom aeromatch_cli.workspace import Workspace, locked\n"
        "with locked(Workspace(Path(sys.argv[1])), 'match', shared=sys.argv[2] == 'shard'):\n"
        "    print('held', flush=True)\n    time.sleep(600)\n"
    )
    for kind, others in (("whole", (3, 3)), ("shard", (3, 0))):
        command = [sys.executable, str(holder), str(done_site.work), kind]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "held\n"
            found = done_site("filter"), done_site("filter", "--shard", "1/2")
            process.kill()
        assert tuple(outcome.code for outcome in found) == others
        assert f"is in use by `aeromatch match`, process {process.pid} on " in found[0].stderr
        assert done_site("filter").code == 0
