"""Pictures that do not lie in a folder of this machine: object stores, web servers and archives, by fsspec.

A machine that needs a picture keeps a copy of it in its cache folder; nothing is written where the pictures lie.
"""

from __future__ import annotations

import contextlib
import os
import uuid
import zlib
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urlsplit

from aeromatch_cli.errors import ConfigError, ItemError

# Variable of the environment that names the cache folder.
CACHE_VARIABLE = "AEROMATCH_CACHE"
_EXTRAS = {"s3": "remote", "http": "remote", "https": "remote", "gs": "gs", "gcs": "gs"}
_ARCHIVES = (".zip",)
# Requests for the facts of single files that are under way at once.
_REQUESTS = 16
# What a store says of the version of a file, the surest first.
_VERSION_KEYS = ("ETag", "etag", "md5Hash", "CRC", "LastModified", "Last-Modified", "mtime", "updated", "date_time")


def is_remote(folder: str) -> bool:
    """Whether --images names something else than a folder: a URL of fsspec, or an archive."""
    return "://" in folder or _is_archive(folder)


def _is_archive(folder: str) -> bool:
    return "://" not in folder and Path(folder).suffix.lower() in _ARCHIVES and not Path(folder).is_dir()


@dataclass(frozen=True)
class RemoteFile:
    """A picture below a remote folder. version: changes with its contents. size_bytes is None and version "" where the
    store does not say.
    """

    folder: str
    name: str
    size_bytes: int | None
    version: str

    @property
    def copy(self) -> Path:
        """Where this machine keeps it."""
        key = sha256(f"{self.folder}\n{self.name}\n{self.size_bytes}\n{self.version}".encode()).hexdigest()[:24]
        return cache_folder() / key[:2] / f"{key}{Path(self.name).suffix}"

    def __str__(self) -> str:
        return f"{self.folder.rstrip('/')}/{self.name}"


def cache_folder() -> Path:
    """Folder of the copies: $AEROMATCH_CACHE, else aeromatch/images in the user's cache folder."""
    if given := os.environ.get(CACHE_VARIABLE):
        return Path(given)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "aeromatch" / "images"


def on_disk(picture: Path | RemoteFile) -> Path:
    """A file of this machine; a remote one is fetched where there is no copy yet, or a damaged one.

    Raises ItemError where it cannot be fetched, ConfigError where the copy cannot be written.
    """
    if isinstance(picture, Path):
        return picture
    path = picture.copy
    if path not in _whole_copies or not path.is_file():
        if not _is_whole(path):
            _fetch(picture, path)
        _whole_copies.add(path)
    return path


# Copies that this process has compared with their checksums.
_whole_copies: set[Path] = set()


def _checksum_file(path: Path) -> Path:
    return path.with_name(f"{path.name}.crc32")


def _is_whole(path: Path) -> bool:
    try:
        return _checksum_file(path).read_text(encoding="ascii") == _checksum(path)
    except (OSError, ValueError):
        return False


def _checksum(path: Path) -> str:
    return f"{zlib.crc32(path.read_bytes()):08x}"


def _fetch(picture: RemoteFile, path: Path) -> None:
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.touch()
    except OSError as error:
        raise ConfigError(
            f"cannot write the cache of pictures {path.parent} ({error.strerror}): name another folder by "
            f"the variable {CACHE_VARIABLE}"
        ) from None
    try:
        system, root = _opened(picture.folder)
        with _named_errors(picture.folder, picture.name):
            system.get_file(_path(system, root, picture.name), str(partial))
        found = partial.stat().st_size
        if picture.size_bytes is not None and found != picture.size_bytes:
            raise ItemError(f"{picture} ends after {found} of {picture.size_bytes} bytes: run the same command again")
        # The time of a copy would differ from machine to machine, and with it the image's fingerprint.
        stamp = zlib.crc32(picture.version.encode())
        os.utime(partial, (stamp, stamp))
        _checksum_file(path).write_text(_checksum(partial), encoding="ascii")  # one cut off counts as damaged
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def list_remote(folder: str) -> dict[str, RemoteFile]:
    """All files below a remote folder, by relative name. Raises ConfigError where it cannot be listed."""
    system, root = _opened(folder)
    with _named_errors(folder, kind=ConfigError):
        found: dict[str, dict[str, Any]] = system.find(root, detail=True)
        if not found and not _is_archive(folder):
            system.info(root)  # raises where it cannot be read
        if _is_archive(folder) and (twice := [n for n, k in Counter(system.zip.namelist()).items() if k > 1]):
            raise ConfigError(f"{folder} holds {twice[0]} more than once: make the archive anew with one of them")
        lacking = [path for path, facts in found.items() if facts.get("size") is None or not _version(facts)]
        with ThreadPoolExecutor(_REQUESTS) as pool:
            found |= dict(zip(lacking, pool.map(system.info, lacking), strict=True))
    files = {}
    for path, facts in found.items():
        name = path if _is_archive(folder) else path[len(root) :].lstrip("/")
        name = unquote(name) if _quotes(system) else name
        if not name:
            raise ConfigError(f"{folder} is a file: give the folder that holds the images, or an archive")
        if facts.get("type", "file") == "file":
            files[name] = RemoteFile(folder, name, facts.get("size"), _version(facts))
    return files


def remote_file(folder: str, name: str) -> RemoteFile:
    """One of them. Raises ItemError where it is not there."""
    system, root = _opened(folder)
    with _named_errors(folder, name):
        facts = system.info(_path(system, root, name))
    return RemoteFile(folder, name, facts.get("size"), _version(facts))


def _path(system: Any, root: str, name: str) -> str:
    """Of a file in its file system; an archive has no root."""
    name = quote(name) if _quotes(system) else name
    return f"{root}/{name}" if root else name


def _quotes(system: Any) -> bool:
    """Whether paths of a file system are URLs, with blanks and accents as %20."""
    protocols = {system.protocol} if isinstance(system.protocol, str) else set(system.protocol)
    return bool(protocols & {"http", "https"})


def _version(facts: dict[str, Any]) -> str:
    return next((str(facts[key]) for key in _VERSION_KEYS if facts.get(key)), "")


@lru_cache(maxsize=8)
def _opened(folder: str) -> tuple[Any, str]:
    """fsspec's file system, and the folder's path in it. Once per process: it keeps its connections."""
    import fsspec

    url = folder
    if "@" in urlsplit(folder).netloc and folder.startswith(("http://", "https://")):
        raise ConfigError(
            "the address of --images holds a user or password, which settings, logs and results would repeat: leave "
            "them out and put them into ~/.netrc (machine HOST login USER password WORD)"
        )
    if "://" not in folder:
        url = f"zip://::file://{Path(folder).resolve().as_posix()}"
    protocol = url.partition("://")[0].rpartition("::")[2]
    with _named_errors(folder, kind=ConfigError):
        try:
            # aiohttp reads ~/.netrc and the variables of proxies only when asked to.
            options = {"client_kwargs": {"trust_env": True}} if protocol in ("http", "https") else {}
            system, root = fsspec.core.url_to_fs(url, **options)
        except ImportError as error:
            extra = _EXTRAS.get(protocol)
            remedy = f"pip install 'aeromatch[{extra}]'" if extra else str(error)
            raise ConfigError(f"{folder}: fsspec lacks what reads {protocol}://: {remedy}") from None
        except ValueError as error:
            raise ConfigError(f"{folder}: {error}") from None
    return system, root.rstrip("/")


@contextlib.contextmanager
def _named_errors(folder: str, name: str = "", kind: type[ConfigError] | type[ItemError] = ItemError) -> Iterator[None]:
    """What stores raise is of many libraries: their words, and what was asked for."""
    what = f"{folder}/{name}" if name else folder
    archive = _is_archive(folder)
    remedy = "check the archive, or make it anew" if archive else "check the address, the network and the credentials"
    try:
        yield
    except (ConfigError, ItemError):
        raise
    except Exception as error:  # noqa: BLE001 - of botocore, aiohttp, zipfile, ...
        cause = error.__cause__ or error  # fsspec says of a refused connection that there is no such file
        words = "it does not exist" if isinstance(cause, FileNotFoundError) else str(cause) or type(cause).__name__
        raise kind(f"{what} cannot be read ({words}): {remedy}") from None
