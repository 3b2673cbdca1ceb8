"""Weights files: read strictly, found by name or path, recorded with their SHA-256."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets import files
from aeromatch_cli.nets.files import (
    SHIPPED_FOLDER,
    WeightsCheck,
    read_tensors,
    sha256_of_file,
    shipped_weights,
    verify_shipped,
)
from aeromatch_cli.nets.folder import add_weights, list_weights, resolve_weights, verify_weights, weights_folder
from aeromatch_cli.nets.lightglue import Dimensions, LightGlue
from aeromatch_cli.stages.weights import manage_weights

DIMENSIONS = Dimensions(input_dim=8, descriptor_dim=16, n_layers=2, num_heads=2, add_scale_ori=True)


@pytest.fixture(autouse=True)
def data_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    return tmp_path / "data"


@pytest.fixture
def lightglue_file(tmp_path: Path) -> Path:
    path = tmp_path / "small.safetensors"
    save_file(LightGlue(DIMENSIONS).state_dict(), path)
    return path


def test_sha256_is_that_of_the_content(tmp_path: Path) -> None:
    (tmp_path / "abc").write_bytes(b"abc")
    # FIPS 180-2, appendix B.1.
    assert sha256_of_file(tmp_path / "abc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_the_folder_follows_xdg(data_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert weights_folder() == data_home / "aeromatch" / "weights"
    monkeypatch.setenv("XDG_DATA_HOME", "relative/is/ignored")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert weights_folder() == tmp_path / ".local" / "share" / "aeromatch" / "weights"


def test_added_weights_are_listed_found_and_verified(lightglue_file: Path) -> None:
    assert list_weights() == ()
    assert verify_weights() == ()
    entry = add_weights(lightglue_file)
    assert entry.sha256 == hashlib.sha256(lightglue_file.read_bytes()).hexdigest()
    assert (entry.name, entry.architecture) == ("small.safetensors", "lightglue")
    assert entry.size_bytes == lightglue_file.stat().st_size
    assert add_weights(lightglue_file) == entry
    assert list_weights() == (entry,)
    stored = weights_folder() / "small.safetensors"
    assert stored.read_bytes() == lightglue_file.read_bytes()
    assert resolve_weights("small") == resolve_weights("small.safetensors") == stored
    assert sorted(path.name for path in weights_folder().iterdir()) == ["index.json", "small.safetensors"]
    assert verify_weights() == (WeightsCheck("small.safetensors", "ok"),)


def test_every_shipped_file_has_a_card_and_is_listed() -> None:
    for entry in shipped_weights():
        path = SHIPPED_FOLDER / entry.name
        assert entry.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
        assert path.with_suffix(".md").read_text(encoding="utf-8").startswith(f"# {entry.name}\n")
        assert entry.size_bytes <= 10_000_000
    assert "shadow" in {entry.architecture for entry in shipped_weights()}
    listed = manage_weights("list", None).lines
    assert all(entry.name in line for entry, line in zip(shipped_weights(), listed, strict=False))


def test_verify_sees_changed_missing_and_foreign_files(lightglue_file: Path, tmp_path: Path) -> None:
    add_weights(lightglue_file)
    other = lightglue_file.rename(tmp_path / "other.safetensors")
    add_weights(other)
    folder = weights_folder()
    content = bytearray((folder / "small.safetensors").read_bytes())
    content[-1] ^= 1
    (folder / "small.safetensors").write_bytes(content)
    (folder / "other.safetensors").unlink()
    (folder / "foreign.pth").write_bytes(b"")
    assert [(check.name, check.state) for check in verify_weights()] == [
        ("foreign.pth", "unrecorded"),
        ("other.safetensors", "missing"),
        ("small.safetensors", "changed"),
    ]


def test_a_taken_name_is_not_overwritten(lightglue_file: Path, tmp_path: Path) -> None:
    first = add_weights(lightglue_file)
    (tmp_path / "again").mkdir()
    namesake = tmp_path / "again" / "small.safetensors"
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        changed = {key: torch.randn_like(value) for key, value in LightGlue(DIMENSIONS).state_dict().items()}
    save_file(changed, namesake)
    with pytest.raises(ConfigError, match="exists with other content"):
        add_weights(namesake)
    assert list_weights() == (first,)


def test_what_no_network_takes_is_not_added(tmp_path: Path) -> None:
    path = tmp_path / "linear.safetensors"
    save_file({"weight": torch.zeros(2, 2)}, path)
    with pytest.raises(ConfigError, match="does not fit LightGlue"):
        add_weights(path)
    assert not weights_folder().exists()


def test_a_path_is_taken_as_it_is(lightglue_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert resolve_weights(str(lightglue_file)) == lightglue_file
    monkeypatch.chdir(lightglue_file.parent)
    assert resolve_weights("small.safetensors") == lightglue_file
    assert resolve_weights("./small.safetensors") == lightglue_file


def test_unknown_weights_say_what_to_do(lightglue_file: Path) -> None:
    add_weights(lightglue_file)
    with pytest.raises(ConfigError, match=r"'sift'.*there: small.safetensors.*aeromatch weights add PATH"):
        resolve_weights("sift")


def test_a_broken_index_says_what_to_do(lightglue_file: Path) -> None:
    add_weights(lightglue_file)
    (weights_folder() / "index.json").write_text("{")
    with pytest.raises(ConfigError, match=r"index.json cannot be read.*delete it"):
        list_weights()


@pytest.mark.parametrize("suffix", [".pth", ".pt", ".safetensors"])
def test_every_format_reads_the_same_tensors(tmp_path: Path, suffix: str) -> None:
    tensors = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.tensor([1.5])}
    path = tmp_path / f"file{suffix}"
    if suffix == ".safetensors":
        save_file(tensors, path)
    else:
        torch.save(tensors, path)
    read = read_tensors(path)
    assert read.keys() == tensors.keys()
    assert all(torch.equal(read[key], tensors[key]) for key in tensors)


@pytest.mark.parametrize("container", ["model", "state_dict"])
def test_a_training_checkpoint_is_taken_by_its_network(tmp_path: Path, container: str) -> None:
    torch.save({container: {"a": torch.ones(2)}, "epoch": 3}, tmp_path / "checkpoint.pth")
    assert torch.equal(read_tensors(tmp_path / "checkpoint.pth")["a"], torch.ones(2))


@pytest.mark.parametrize("name", ["damaged.pth", "damaged.safetensors"])
def test_damaged_files_are_named(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"not a weights file")
    with pytest.raises(ConfigError, match=f"{name} is damaged or not"):
        read_tensors(tmp_path / name)


def test_a_truncated_file_is_named(lightglue_file: Path) -> None:
    lightglue_file.write_bytes(lightglue_file.read_bytes()[:-100])
    with pytest.raises(ConfigError, match=r"small\.safetensors is damaged or not a safetensors file"):
        read_tensors(lightglue_file)


def test_nothing_in_a_file_is_executed(tmp_path: Path) -> None:
    marker = tmp_path / "executed"

    class Bomb:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return Path.touch, (str(marker),)

    torch.save({"a": Bomb()}, tmp_path / "bomb.pth")
    with pytest.raises(ConfigError, match="is damaged or not what"):
        read_tensors(tmp_path / "bomb.pth")
    assert not marker.exists()


def test_other_contents_are_refused(tmp_path: Path) -> None:
    torch.save([1, 2], tmp_path / "list.pth")
    with pytest.raises(ConfigError, match="no named tensors"):
        read_tensors(tmp_path / "list.pth")
    torch.save({"a": 1.0}, tmp_path / "number.pth")
    with pytest.raises(ConfigError, match="entry 'a' is not a tensor"):
        read_tensors(tmp_path / "number.pth")
    save_file({"a": torch.tensor([1.0, float("nan")])}, tmp_path / "nan.safetensors")
    with pytest.raises(ConfigError, match="tensor a holds NaN"):
        read_tensors(tmp_path / "nan.safetensors")
    (tmp_path / "weights.onnx").touch()
    with pytest.raises(ConfigError, match=r"unknown suffix '.onnx'; use one of .safetensors"):
        read_tensors(tmp_path / "weights.onnx")
    with pytest.raises(ConfigError, match=r"absent\.pth does not exist"):
        read_tensors(tmp_path / "absent.pth")


def test_what_ships_is_what_its_sums_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = {entry.name for entry in shipped_weights()}
    assert {check.name for check in verify_shipped()} == names
    assert {check.state for check in verify_shipped()} == {"ok"}
    copy = tmp_path / "trained"
    shutil.copytree(files.SHIPPED_FOLDER, copy)
    monkeypatch.setattr(files, "SHIPPED_FOLDER", copy)
    (copy / "shadow.safetensors").unlink()
    with (copy / "lightglue.safetensors").open("r+b") as stream:
        stream.truncate(1_000_000)
    assert [(c.name, c.state) for c in verify_shipped() if c.state != "ok"] == [
        ("lightglue.safetensors", "changed"),
        ("shadow.safetensors", "missing"),
    ]


@pytest.mark.parametrize("shape", [(), (0, 4)])
def test_matrices_that_are_none_are_refused(lightglue_file: Path, tmp_path: Path, shape: tuple[int, ...]) -> None:
    tensors = read_tensors(lightglue_file)
    for name in ("posenc.Wr.weight", "input_proj.weight"):
        broken = tmp_path / "broken.safetensors"
        save_file({**tensors, name: torch.zeros(shape)}, broken)
        with pytest.raises(ConfigError, match=f"{name} of shape .* is no matrix"):
            add_weights(broken)
    save_file({name: value.to(torch.int8) for name, value in tensors.items()}, tmp_path / "whole.safetensors")
    with pytest.raises(ConfigError, match=r"torch\.int8; export floating point"):
        add_weights(tmp_path / "whole.safetensors")
