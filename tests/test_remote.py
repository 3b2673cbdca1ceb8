"""Images that lie elsewhere: an archive, a web server, an object store. The results are those of a folder."""

from __future__ import annotations

import functools
import http.server
import shutil
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import Site

from aeromatch_cli.blocks.scan import scan_files
from aeromatch_cli.errors import ConfigError, ItemError
from aeromatch_cli.fingerprints import image_fingerprint
from aeromatch_cli.images import remote
from aeromatch_cli.images.remote import RemoteFile, cache_folder, is_remote, list_remote, on_disk

RUN = ("run", "--set", "orient=none", "--set", "extract.keypoints=200")


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("AEROMATCH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def archive(tmp_path: Path, rendered: Path) -> Path:
    path = tmp_path / "block.zip"
    with zipfile.ZipFile(path, "w") as out:
        for image in sorted((rendered / "images").iterdir()):
            out.write(image, f"flight 1/{image.name}")
        out.writestr("flight 1/._a.jpg", b"x")
        out.writestr("flight 1/.hidden.jpg", b"x")
        out.writestr("empty.jpg", b"")
        out.writestr("poses.csv", b"x")
    return path


def fetched(folder: str, names: Iterator[str] | list[str]) -> dict[str, bytes]:
    files = list_remote(folder)
    return {name: on_disk(files[name]).read_bytes() for name in names}


def verified(work: Path) -> dict[str, bytes]:
    found = {}
    for path in sorted((work / "verified").glob("*.npz")):
        with np.load(path) as row:
            found[path.name] = row["indices"].tobytes() + row["errors_px"].tobytes()
    return found


def test_what_counts_as_remote(tmp_path: Path) -> None:
    assert [is_remote(one) for one in ("s3://a/b", "https://host/a/", "a/b.zip", "a.ZIP")] == [True] * 4
    (tmp_path / "folder.zip").mkdir()
    assert not is_remote(str(tmp_path / "folder.zip"))
    assert not is_remote("images")


def test_an_archive_holds_the_pictures_of_a_folder(archive: Path, rendered: Path) -> None:
    files = list_remote(str(archive))
    names, failures = scan_files({name: file.size_bytes for name, file in files.items()})
    originals = {f"flight 1/{path.name}": path.read_bytes() for path in (rendered / "images").iterdir()}
    assert names == sorted(originals)
    assert [(one.name, one.image_lost) for one in failures] == [("empty.jpg", True), ("flight 1/._a.jpg", False)]
    assert fetched(str(archive), names) == originals


def test_a_copy_has_the_same_fingerprint_on_every_machine(
    archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, file = next(item for item in sorted(list_remote(str(archive)).items()) if item[0].endswith("0001.jpg"))
    first = image_fingerprint(on_disk(file))
    monkeypatch.setenv("AEROMATCH_CACHE", str(tmp_path / "another machine"))
    assert image_fingerprint(on_disk(file)) == first, name


def test_a_picture_that_changes_is_fetched_again(tmp_path: Path) -> None:
    paths = []
    for content in (b"first", b"other"):
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as out:
            out.writestr("a.jpg", content)
        file = RemoteFile(str(tmp_path / "a.zip"), "a.jpg", 5, str(zipfile.crc32(content)))  # type: ignore[attr-defined]
        remote._opened.cache_clear()  # a process that goes on would read the archive that it knows
        paths.append(on_disk(file))
        assert paths[-1].read_bytes() == content
    assert paths[0] != paths[1]


def test_a_damaged_copy_is_fetched_again(archive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name, file = next(item for item in sorted(list_remote(str(archive)).items()) if item[0].endswith("0001.jpg"))
    path, sound = on_disk(file), on_disk(file).read_bytes()
    for damaged in (sound[:99] + bytes([sound[99] ^ 1]) + sound[100:], sound[:1000], b""):
        path.write_bytes(damaged)
        monkeypatch.setattr(remote, "_whole_copies", set())  # as in a new process
        assert on_disk(file).read_bytes() == sound, name


def test_entries_that_lead_out_of_an_archive_are_named(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as out:
        for name in ("../evil.jpg", "a/../../up.jpg", "..\\win.jpg", "/abs.jpg", "sound.jpg"):
            out.writestr(name, b"x")
    files = list_remote(str(tmp_path / "a.zip"))
    names, failures = scan_files({name: file.size_bytes for name, file in files.items()})
    assert names == ["sound.jpg"]
    assert {one.name for one in failures} == {"..\\win.jpg", "../evil.jpg", "a/../../up.jpg", "/abs.jpg"}
    assert {one.reason for one in failures} == {"leads out of the folder: it is not read"}


def test_an_archive_with_a_name_twice_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as out:
        out.writestr("a.jpg", b"x")
        with pytest.warns(UserWarning, match="Duplicate name"):
            out.writestr("a.jpg", b"y")
    with pytest.raises(ConfigError, match=r"a\.zip holds a\.jpg more than once: make the archive anew"):
        list_remote(str(tmp_path / "a.zip"))
    with zipfile.ZipFile(tmp_path / "empty.zip", "w"):
        pass
    assert list_remote(str(tmp_path / "empty.zip")) == {}
    (tmp_path / "no.zip").write_bytes(b"no archive")
    with pytest.raises(ConfigError, match=r"no\.zip cannot be read \(.*\): check the archive, or make it anew"):
        list_remote(str(tmp_path / "no.zip"))


@pytest.mark.slow
def test_a_run_of_an_archive_equals_that_of_a_folder(site: Site, archive: Path) -> None:
    flat = archive.with_name("flat.zip")
    with zipfile.ZipFile(flat, "w") as out:
        for image in sorted(site.images.iterdir()):
            out.write(image, image.name)
    assert site(*RUN).code == 0
    expected = verified(site.work)
    assert expected
    elsewhere = site.root / "elsewhere"
    outcome = site(*RUN, "--images", flat, "--workspace", elsewhere)
    assert outcome.code == 0, outcome.stderr
    assert verified(elsewhere) == expected
    # A second run, and one of another machine that has no copies yet, do nothing.
    assert site(*RUN, "--images", flat, "--workspace", elsewhere).done() == {}
    shutil.rmtree(cache_folder())
    assert site(*RUN, "--images", flat, "--workspace", elsewhere).done() == {}


@pytest.fixture
def web(site: Site) -> Iterator[str]:
    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *words: object) -> None:
            """Nothing."""

    handler = functools.partial(Quiet, directory=str(site.root))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def test_pictures_of_a_web_server(site: Site, web: str) -> None:
    pytest.importorskip("aiohttp")
    originals = {path.name: path.read_bytes() for path in site.images.iterdir()}
    assert fetched(f"{web}/images", sorted(originals)) == originals
    with pytest.raises(ConfigError, match=r"nowhere cannot be read \(.*404.*\): check the address"):
        list_remote(f"{web}/nowhere")
    one = site.image(0).name
    with pytest.raises(ConfigError, match="is a file: give the folder that holds the images"):
        list_remote(f"{web}/images/{one}")
    with pytest.raises(ConfigError, match=r"cannot be read \(.*[Cc]onnect.*\): check the address"):
        list_remote("http://127.0.0.1:9/images")


def test_a_password_in_an_address_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"holds a user or password.*~/\.netrc") as raised:
        list_remote("https://me:secret@127.0.0.1/images")
    assert "secret" not in str(raised.value)


def test_names_on_a_web_server_are_those_of_the_folder(site: Site, web: str) -> None:
    pytest.importorskip("aiohttp")
    odd = site.image(0).rename(site.images / "Flug ü b&c#1 100%.jpg")
    assert fetched(f"{web}/images", [odd.name]) == {odd.name: odd.read_bytes()}


@pytest.fixture
def bucket(site: Site, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """An S3 server on this machine."""
    pytest.importorskip("s3fs")
    boto3, moto = pytest.importorskip("boto3"), pytest.importorskip("moto.server")
    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    address = "http://{}:{}".format(*server.get_host_and_port())
    for name, value in (
        ("AWS_ACCESS_KEY_ID", "key"), ("AWS_SECRET_ACCESS_KEY", "secret"), ("AWS_DEFAULT_REGION", "eu-west-1"),
        ("AWS_ENDPOINT_URL", address),
    ):  # fmt: skip
        monkeypatch.setenv(name, value)
    client = boto3.client("s3", endpoint_url=address)
    client.create_bucket(Bucket="flights", CreateBucketConfiguration={"LocationConstraint": "eu-west-1"})
    for image in sorted(site.images.iterdir()):
        client.upload_file(str(image), "flights", f"2026/{image.name}")
    yield "s3://flights/2026"
    server.stop()


@pytest.mark.slow
def test_a_run_of_a_bucket_equals_that_of_a_folder(site: Site, bucket: str, cache: Path) -> None:
    assert site(*RUN).code == 0
    elsewhere = site.root / "elsewhere"
    for more in ((), ("--jobs", "2", "--overwrite")):
        shutil.rmtree(cache, ignore_errors=True)
        outcome = site(*RUN, "--images", bucket, "--workspace", elsewhere, *more)
        assert outcome.code == 0, outcome.stderr
        assert verified(elsewhere) == verified(site.work)
    assert len(list(cache.rglob("*.jpg"))) == len(list(site.images.iterdir()))


def test_an_address_that_does_not_answer_is_named(site: Site, tmp_path: Path) -> None:
    (tmp_path / "broken.zip").write_bytes(b"no archive")
    for images, words in (
        (tmp_path / "broken.zip", "File is not a zip file"),
        (tmp_path / "absent.zip", "absent.zip cannot be read"),
        ("nothing://a/b", "Protocol not known: nothing"),
    ):
        outcome = site("run", "--images", images, "--workspace", tmp_path / "w")
        assert outcome.code == 2
        assert words in outcome.stderr
    assert not (tmp_path / "w" / "images.csv").exists()


def test_a_picture_that_ends_too_early_is_refused(archive: Path) -> None:
    short = RemoteFile(str(archive), "poses.csv", 5, "1")
    with pytest.raises(ItemError, match=r"poses.csv ends after 1 of 5 bytes: run the same command again"):
        on_disk(short)
    assert not short.copy.exists()
