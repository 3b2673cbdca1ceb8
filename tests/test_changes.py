"""What is said of a workspace before its results are replaced."""

from __future__ import annotations

import pytest
from conftest import Site, invoke

from aeromatch_cli.config import dump, load
from aeromatch_cli.stages.settings_diff import changed_words


def test_changed_settings_and_the_first_stage_that_reads_them_are_named(tmp_path) -> None:
    before = load("baseline", ["extract.keypoints=4000"], {"images": str(tmp_path)})
    config = tmp_path / "config.yaml"
    assert changed_words(config, before) == ""
    config.write_text(dump(before), encoding="utf-8")
    assert changed_words(config, before) == ""
    assert changed_words(config, load("baseline", ["extract.keypoints=4000"], {"images": f"{tmp_path}/."})) == ""
    now = load("baseline", ["extract.keypoints=9000", "match.guided=true"], {"images": str(tmp_path)})
    assert changed_words(config, now) == (
        "extract.keypoints 4000 -> 9000, match.guided false -> true: what depends on it is made again, from extract on"
    )
    auto = changed_words(config, load("auto", ["extract.keypoints=4000"], {"images": str(tmp_path)}))
    assert "cascade none -> guided+learned" in auto
    assert auto.endswith("from pairs on")
    jobs = load("baseline", ["extract.keypoints=4000", "run.jobs=7"], {"images": str(tmp_path)})
    assert changed_words(config, jobs) == ""
    surveyed = load("baseline", ["extract.keypoints=4000"], {"images": str(tmp_path), "gcp": str(tmp_path / "g.txt")})
    assert changed_words(config, surveyed).endswith("from adjust on")
    seeded = load("baseline", ["extract.keypoints=4000", "seed=3"], {"images": str(tmp_path)})
    assert changed_words(config, seeded).endswith("from filter on")
    config.write_text("{", encoding="utf-8")
    assert changed_words(config, now) == ""


@pytest.mark.slow
def test_a_run_and_a_check_say_it_first_and_once(done_site: Site) -> None:
    given = ["baseline", *done_site.options()]
    assert "changed  " not in invoke("run", *given).stdout
    other = [*given, "--set", "match.ratio=0.75"]
    checked = invoke("check", *other).stdout
    assert "changed          match.ratio" in checked
    made = invoke("run", *other).stdout
    assert made.count("changed  ") == 1
    assert made.index("changed  ") < made.index("images  ")
    assert "-> 0.75: what depends on it is made again, from match on" in made
    assert "changed  " not in invoke("run", *other).stdout
