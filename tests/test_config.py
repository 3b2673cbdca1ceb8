from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml

from aeromatch_cli.config import FAMILIES, Settings, dump, load, parse_method, preset_names, validate
from aeromatch_cli.config.page import page
from aeromatch_cli.config.text import default_yaml
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.fingerprints import fingerprint

CONFIGS = Path(__file__).parent.parent / "configs"


def write(folder: Path, text: str | bytes, name: str = "block.yaml") -> str:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return str(path)


def fault(source: str, *overrides: str) -> str:
    """The message of the ConfigError that a configuration must cause."""
    with pytest.raises(ConfigError) as caught:
        load(source, overrides)
    assert caught.value.exit_code == 2
    return str(caught.value)


# --- the commented default ----------------------------------------------------------------------------------------


def test_default_yaml_is_up_to_date() -> None:
    stored = (CONFIGS / "default.yaml").read_text(encoding="utf-8")
    assert stored == default_yaml(), "run: python -m aeromatch_cli.config.text > configs/default.yaml"


def test_the_configuration_page_is_up_to_date() -> None:
    stored = (CONFIGS.parent / "docs" / "configuration.md").read_text(encoding="utf-8")
    assert stored == page(), "run: python -m aeromatch_cli.config.page > docs/configuration.md"


@pytest.mark.parametrize("name", preset_names())
def test_the_page_says_what_a_preset_sets(name: str) -> None:
    """What stands there as --set options makes the preset of the defaults."""
    comment = next(line for line in page().splitlines() if line.startswith(f"- `{name}`:"))
    written = page().splitlines()[page().splitlines().index(comment) + 1]
    assert load("baseline", re.findall(r"`([^`]+)`", written)) == load(name)


def test_default_and_baseline_are_the_defaults() -> None:
    assert "baseline" in preset_names()
    assert load("default") == load("baseline") == Settings()


def test_default_yaml_names_every_key_and_describes_it() -> None:
    lines = default_yaml().splitlines()
    for family in FAMILIES.values():
        for strategy in family.values():
            for key, field in strategy.model_fields.items():
                assert key == "name" or field.description, f"{strategy.__name__}.{key} has no description"
                assert any(line.lstrip("#- ").startswith(f"{key}:") for line in lines)
    assert all(len(line) <= 120 for line in lines)


def test_other_strategies_in_default_yaml_are_valid_when_uncommented() -> None:
    """Every commented section, taken out of its comment, gives that strategy with its defaults."""
    chosen = set()
    text, block = default_yaml(), []
    for line in [*text.splitlines(), "#"]:
        if line.startswith("# ") and (block or any(line == f"# {key}:" for key in FAMILIES)):
            block.append(line[2:])
        elif block:
            tree = yaml.safe_load("\n".join(block))
            (key,) = tree
            if key == "filter":
                tree[key].append("poselib")  # not every filter may stand alone
                tree["extract"] = {"name": "sift", "colours": True}  # and one reads colours
            if key == "extract" and tree[key]["name"] == "grid":
                tree["match"] = {"name": "polar"}  # nothing else can compare what has no descriptors
            if key == "match" and tree[key]["name"] in ("lightglue-learned", "lightglue-aliked"):
                tree["extract"] = {"name": tree[key]["name"].removeprefix("lightglue-")}  # it knows no others
            settings = validate(tree)
            strategy = getattr(settings, key)[0] if isinstance(tree[key], list) else getattr(settings, key)
            assert strategy == type(strategy)()
            chosen.add((key, strategy.name))
            block = []
    active = {(key, name) for key, table in FAMILIES.items() for name in table} - chosen
    # One of each family is the default, none of the cascade's steps; all others are shown.
    assert sorted(key for key, _ in active) == sorted(FAMILIES.keys() - {"cascade"})


def test_oblique_is_what_its_tables_say() -> None:
    found = load("oblique")
    assert found.pairs.max_view_angle_deg == 90.0
    assert (found.simulate.name, found.extract.name) == ("neighbours", "learned")
    assert (found.match.name, found.match.guided, found.match.expect_places) == ("lightglue-learned", True, True)
    assert [one.name for one in found.filter] == ["epipolar", "graph"]


@pytest.mark.parametrize("name", [*preset_names(), "default"])
def test_every_preset_loads(name: str) -> None:
    assert isinstance(load(name), Settings)


# --- faults -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("extract.keypointz=3", "extract.keypointz: unknown key; did you mean 'keypoints'?"),
        ("extractt.keypoints=3", "extractt: unknown key; did you mean 'extract'?"),
        ("block.sigmaangle=1", "block.sigmaangle: unknown key; did you mean 'sigma_angle_deg'?"),
        ("run.job=1", "run.job: unknown key; did you mean 'jobs'?"),
        ("filter.poselib.threshold=2", "filter.poselib.threshold: unknown key; did you mean 'threshold_px'?"),
        ("export.colmap.raw_matchez=false", "export.colmap.raw_matchez: unknown key; did you mean 'raw_matches'?"),
        ("match.weights=a.pt", "match.weights: unknown key here, it belongs to lightglue"),
        ("extract.keypoints=many", "extract.keypoints: must be a whole number (got 'many')"),
        ("extract.keypoints=1.5", "extract.keypoints: must be a whole number (got 1.5)"),
        ("extract.keypoints=-3", "extract.keypoints: must be greater than or equal to 1 (got -3)"),
        ("extract=siftt", "extract: no strategy is named 'siftt'; did you mean 'sift'?"),
        ("match=lightgleu", "match: no strategy is named 'lightgleu'; did you mean 'lightglue'?"),
        ("filter=pose+poselip", "filter: no strategy is named 'poselip'; did you mean 'poselib'?"),
        ("pairs=none", "pairs: no strategy is named 'none'; valid here: overlap"),
        ("run.executor=Serial", "run.executor: must be 'serial', 'processes' or 'dask' (got 'Serial')"),
        ("run.jobs=yes", "run.jobs: must be a number (got True)"),
        ("seed=true", "seed: must be a number (got True)"),
        ("seed=-1", "seed: must be greater than or equal to 0"),
        ("block.sigma_angle_deg=.inf", "block.sigma_angle_deg: must be a finite number"),
        ("block.sigma_position_m=nan", "block.sigma_position_m: must be a finite number"),
        ("match.ratio=.nan", "match.ratio: must be a finite number"),
        ("run.keep_images=maybe", "run.keep_images: must be true or false"),
        ("workspace=", "workspace: must not be empty"),
        ("block=3", "block: must hold settings"),
        ("block.images.x=3", "block.images: must be text"),
        ("export=colmap+colmap", "export: each at most once"),
        ("cascade=learned+learned", "cascade: each at most once"),
        ("filter=none", "filter: must name at least one strategy"),
        ("filter=[]", "filter: must name at least one strategy"),
        ("a", "write key.sub=value"),
        ("=3", "write key.sub=value"),
        ("extract..keypoints=3", "write key.sub=value"),
        ("filter.threshold_px=2", "filter.poselib.KEY=VALUE"),
        ("filter.poselib=3", "filter.poselib.KEY=VALUE"),
        ("filter.pose.sigmas=2", "first --set filter=pose+poselib"),
    ],
)
def test_faults_name_the_place_and_the_nearest_valid_key(override: str, expected: str) -> None:
    assert expected in fault("baseline", override)


def test_every_fault_is_listed_at_once(tmp_path: Path) -> None:
    text = "blok: 1\nblock: {imagse: x}\nextract: {keypointz: 3}\nfilter: [{name: poselib, thresh: 1}]\nseed: x\n"
    message = fault(write(tmp_path, text))
    for place in ("blok", "block.imagse", "extract.keypointz", "filter.poselib.thresh", "seed"):
        assert f"  {place}: " in message
    assert "block.yaml):" in message


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[1, 2]", "must hold keys and values at the top"),
        ("3", "must hold keys and values at the top"),
        ("seed: 1\nseed: 2\n", "the key 'seed' is written twice"),
        ("extract:\n  keypoints: 1\n  keypoints: 2\n", "line 3"),
        (b"workspace: \xff\n", "save it as UTF-8"),
        ("a:\n\t- x", "is not YAML"),
        ("seed: !!python/object/apply:os.getcwd []\n", "is not YAML"),
        ("seed: 1\n---\nseed: 2\n", "is not YAML"),
        ("workspace: 2020-13-45\n", "no calendar has"),
        ("workspace: 2020-01-01\n", "put it in quotes"),
        ("[" * 1000, "nested too deeply"),
        ("1: 2\n", "keys must be text (got 1)"),
        ("extract: {3: 4}\n", "extract: keys must be text (got 3)"),
        ('block: {images: "a\\0b"}\n', "must not hold a null character"),
        ("filter: [{threshold_px: 2}]\n", "filter: name the strategy (name: ...), one of poselib, pose"),
        ("filter: 3\n", "filter: must be a list, or names joined by +"),
        ("extract:\n", "extract: a value is missing; one of sift"),
    ],
)
def test_broken_files(tmp_path: Path, text: str | bytes, expected: str) -> None:
    assert expected in fault(write(tmp_path, text))


def test_missing_sources(tmp_path: Path) -> None:
    assert "did you mean 'baseline'?" in fault("baselin")
    assert f"--images {tmp_path}" in fault(str(tmp_path))
    assert "No such file" in fault(str(tmp_path / "none.yaml"))


# --- what a source and its overrides mean -------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["", "# nothing\n", "null\n", "block:\nrun:\n", "\ufeff\n", "extract: {}\n"])
def test_empty_files_and_sections_change_nothing(tmp_path: Path, text: str) -> None:
    """A file that names no preset stands on auto, as a command does."""
    assert load(write(tmp_path, text)) == load("auto")


def test_a_file_names_the_preset_that_it_changes(tmp_path: Path) -> None:
    assert load(write(tmp_path, "preset: baseline\n")) == Settings()
    found = load(write(tmp_path, "preset: fusion\nmatch: {guided: false}\n"))
    assert found == load("fusion", ["match.guided=false"])
    assert "preset 'fusoin' is none of auto, baseline, fusion, oblique, polar" in fault(
        write(tmp_path, "preset: fusoin\n")
    )
    assert "did you mean 'fusion'?" in fault(write(tmp_path, "preset: fusoin\n"))


def test_the_workspaces_own_file_is_whole(tmp_path: Path) -> None:
    """Nothing of auto is added to it."""
    settings = load("baseline", ["extract.keypoints=77"], workspace=str(tmp_path))
    assert load(write(tmp_path, dump(settings))) == settings


def test_steps_of_a_cascade_are_taken_cheapest_first() -> None:
    assert [step.name for step in load("auto", ["cascade=learned+guided"]).cascade] == ["guided", "learned"]
    assert "cascade=none" in fault("oblique", "cascade=learned")


def test_a_file_holds_only_differences(tmp_path: Path) -> None:
    found = load(
        write(tmp_path, "extract:\n  keypoints: 77\nfilter: pose+poselib\nblock: {ground: 12.5, crs: 32633}\n")
    )
    assert found.extract == Settings().extract.model_copy(update={"keypoints": 77})
    assert [one.name for one in found.filter] == ["pose", "poselib"]
    assert (found.block.ground, found.block.crs) == ("12.5", "32633")
    assert found.pairs == load("auto").pairs


def test_overrides_reach_strategies_and_chains() -> None:
    found = load("baseline", ["filter=pose+poselib", "filter.poselib.threshold_px=2", "block.sigma_angle_deg=1"])
    assert [one.name for one in found.filter] == ["pose", "poselib"]
    assert found.filter[1].threshold_px == 2.0
    assert found.filter[0] == FAMILIES["filter"]["pose"]()
    assert found.block.sigma_angle_deg == 1.0
    assert load("baseline", ["filter=[pose, {name: poselib, min_inliers: 20}]"]).filter[1].min_inliers == 20
    assert load("baseline", ["export=none"]).export == ()


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("none", ()),
        ("[]", ()),
        ("b1", ("b1",)),
        ("k1+k2", ("k1", "k2")),
        ("k1 + k2+k3", ("k1", "k2", "k3")),
        ("[b1, b2]", ("b1", "b2")),
        ("f+cx+cy+k1+k2+k3+p1+p2+b1+b2", ("f", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "b1", "b2")),
    ],
)
def test_lists_of_parameters_are_written_like_chains(text: str, names: tuple[str, ...]) -> None:
    assert load("baseline", [f"adjust.hold={text}"]).adjust.hold == names
    assert load("baseline", [f"adjust.free={text}"]).adjust.free == names


def test_a_parameter_is_not_free_and_held() -> None:
    assert "free and hold both name k1" in fault("baseline", "adjust.hold=k1+b1", "adjust.free=f+k1")


def test_an_unknown_parameter_of_a_list_is_named() -> None:
    assert "(got 'k9')" in fault("baseline", "adjust.hold=k1+k9")


def test_the_page_has_every_section() -> None:
    text = page()
    assert all(f"\n## {key}\n" in text for key in (*FAMILIES, "block", "adjust", "run"))


@pytest.mark.parametrize("switch", ["match=lightglue", "match.name=lightglue", "match={name: lightglue}"])
def test_another_strategy_drops_the_keys_of_the_first(switch: str) -> None:
    found = load("baseline", ["match.ratio=0.5", switch, "match.weights=x"])
    assert found.match == FAMILIES["match"]["lightglue"](weights="x")


def test_switching_back_gives_defaults(tmp_path: Path) -> None:
    source = write(tmp_path, "match: {name: lightglue, weights: x}\n")
    assert load(source, ["match=nearest"]).match == Settings().match


def test_naming_the_same_strategy_keeps_its_settings() -> None:
    assert load("baseline", ["match.ratio=0.5", "match=nearest"]).match.ratio == 0.5


@pytest.mark.parametrize("name", ["007", "no", "2024-06-31", "1:30", "null", "a=b", "[x"])
def test_text_on_the_command_line_is_taken_as_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert load("baseline", [f"block.images={name}"]).block.images == str(tmp_path / name)


def test_paths_in_a_file_are_relative_to_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "project" / "nets").mkdir(parents=True)
    (tmp_path / "project" / "nets" / "own.pt").write_bytes(b"")
    monkeypatch.chdir(tmp_path)
    text = (
        "workspace: work\nblock: {images: imgs, poses: p.csv, cameras: folder, ground: dem.tif, masks: ../m}\n"
        "pairs: {name: file, path: list.txt}\nmatch: {name: lightglue, weights: nets/own.pt}\n"
    )
    found = load(write(tmp_path / "project", text), block={"images": None})
    project = tmp_path / "project"
    assert found.workspace == str(project / "work")
    assert found.block.images == str(project / "imgs")
    assert found.block.poses == str(project / "p.csv")
    assert found.block.cameras == "folder"
    assert found.block.ground == str(project / "dem.tif")
    assert found.block.masks == str(tmp_path / "m")
    assert found.pairs.path == str(project / "list.txt")
    assert found.match.weights == str(project / "nets" / "own.pt")


def test_paths_on_the_command_line_are_relative_to_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "project").mkdir()
    source = write(tmp_path / "project", "block: {images: imgs}\npairs: {name: file}\nmatch: {name: lightglue}\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    options = ["pairs.path=list.txt", "match.weights=name-in-the-folder", "block.masks=~/m", "block.poses=~nobody-x/p"]
    found = load(source, options, block={"images": "mine", "ground": "-3.5"}, workspace="work")
    assert found.block.images == str(tmp_path / "mine")
    assert found.block.ground == "-3.5"
    assert found.block.masks == str(tmp_path / "home" / "m")
    assert found.block.poses == str(tmp_path / "~nobody-x/p")
    assert found.workspace == str(tmp_path / "work")
    assert found.pairs.path == str(tmp_path / "list.txt")
    assert found.match.weights == "name-in-the-folder"


def test_a_file_in_the_current_folder_does_not_hide_a_preset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "baseline").mkdir()
    (tmp_path / "default").write_text("seed: 5\n")
    monkeypatch.chdir(tmp_path)
    assert load("baseline") == load("default") == Settings()
    assert load("./default").seed == 5


# --- the resolved configuration -----------------------------------------------------------------------------------


def test_the_dumped_configuration_gives_the_same_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`aeromatch run WORK/config.yaml`, from any folder, means the run that wrote it."""
    monkeypatch.chdir(tmp_path)
    options = ["filter=pose+poselib", "filter.pose.sigmas=1e-3", "pairs=file", "pairs.path=list é.txt", "seed=3"]
    (tmp_path / "list é.txt").write_text("a b\n")
    first = load("baseline", options, {"images": "imgs", "ground": "7"}, workspace="work")
    (tmp_path / "work").mkdir()
    written = write(tmp_path / "work", dump(first), "config.yaml")
    monkeypatch.chdir("/")
    again = load(written)
    assert again == first
    assert [fingerprint(getattr(again, key)) for key in FAMILIES] == [
        fingerprint(getattr(first, key)) for key in FAMILIES
    ]
    tree = yaml.safe_load(dump(first))
    assert set(tree) == set(Settings.model_fields)
    assert set(tree["extract"]) == set(type(first.extract).model_fields)


def test_a_moved_workspace_runs_where_it_lies(tmp_path: Path) -> None:
    (tmp_path / "moved").mkdir()
    written = write(tmp_path / "moved", dump(load("baseline", workspace="/elsewhere")), "config.yaml")
    assert load(written).workspace == str(tmp_path / "moved")


def test_settings_are_hashable_and_frozen() -> None:
    settings = load("baseline", ["filter=pose+poselib"])
    assert hash(settings) == hash(load("baseline", ["filter=pose+poselib"]))
    with pytest.raises(ValueError, match="frozen"):
        settings.seed = 3  # type: ignore[misc]


def test_parse_method() -> None:
    assert parse_method("fusion") == ("fusion", [])
    assert parse_method("fusion[enhance=none,match.ratio=0.7]") == ("fusion", ["enhance=none", "match.ratio=0.7"])
    with pytest.raises(ConfigError):
        parse_method("fusion[")


def test_a_workspace_stands_for_its_settings(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(dump(load("baseline", ["extract.keypoints=321"])))
    with pytest.raises(ConfigError, match="is a folder: give a folder of images"):
        load(str(tmp_path))
    (tmp_path / "block.json").write_text("{}")
    assert load(str(tmp_path)).extract.keypoints == 321
    assert load(str(tmp_path)).workspace == str(tmp_path)
