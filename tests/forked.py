"""Processes of the mapper and the refiner, forked from one that has loaded their libraries: loading is half of what
they need for a small block, and a run has two or three of them.

A fork runs the module as `python -m` does, with the same arguments, environment, folder, output and exit code. Commands
that tests start as processes of their own have no part in this: their mappers start as a user's do.

Tests run the same small block through the same settings again and again. What a mapper makes of a folder depends on the
files in it alone (`test_a_mapper_makes_the_same_bytes_again`): it is kept by their contents, and made once.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import runpy
import shutil
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import forkserver
from pathlib import Path
from unittest import mock

from aeromatch_cli.fingerprints import contents_digest, fingerprint
from aeromatch_cli.workers import ONE_THREAD

# Modules that read the files of the folder that they are given and no others.
_OF_A_FOLDER = ("aeromatch_cli.sfm.mapping_process", "aeromatch_cli.sfm.adjustment_process")
# Not the modules that are run: they would be there twice.
_LIBRARIES = ("pycolmap", "scipy.linalg", "scipy.optimize", "scipy.sparse.linalg", "scipy.spatial.transform")

if multiprocessing.current_process().name != "MainProcess" or sys.argv[:1] == ["-c"]:  # in the server
    zlib.compress(b"")  # pycolmap aborts when it is the first user of zlib
    for _name in _LIBRARIES:
        importlib.import_module(_name)


def kept_run(
    kept: Path, command: Sequence[str], *, env: Mapping[str, str], **_: object
) -> subprocess.CompletedProcess[str]:
    """The same as `run`; what a module makes of a folder comes from `kept` where it was made before."""
    module, folder = command[2], Path(command[-1])
    if module not in _OF_A_FOLDER:
        return run(command, env=env)
    given = {str(path.relative_to(folder)): contents_digest(path) for path in folder.rglob("*") if path.is_file()}
    place = kept / fingerprint(module, given)
    if place.is_dir():
        shutil.copytree(place, folder, dirs_exist_ok=True)
        return subprocess.CompletedProcess(command, 0, "", "")
    done = run(command, env=env)
    if done.returncode == 0:
        kept.mkdir(exist_ok=True)
        made = Path(tempfile.mkdtemp(dir=kept))
        for path in folder.iterdir():
            if path.is_file() and path.name not in given:
                shutil.copy2(path, made)
        with suppress(OSError):  # another process was faster
            made.rename(place)
    return done


def run(command: Sequence[str], *, env: Mapping[str, str], **_: object) -> subprocess.CompletedProcess[str]:
    """Of `subprocess.run`, what `sfm.process` uses: a module by name, output as text."""
    python, dash_m, module, *arguments = command
    assert (python, dash_m) == (sys.executable, "-m")
    with tempfile.TemporaryDirectory() as folder:
        out = [Path(folder) / name for name in ("stdout", "stderr")]
        given = module, arguments, dict(env), str(Path.cwd()), [str(path) for path in out]
        process = multiprocessing.get_context("forkserver").Process(target=_run, args=given)
        process.start()
        process.join()
        said = [path.read_text(errors="replace") if path.is_file() else "" for path in out]
    return subprocess.CompletedProcess(command, process.exitcode, *said)


def _run(module: str, arguments: Sequence[str], env: Mapping[str, str], folder: str, out: Sequence[str]) -> None:
    for number, path in enumerate(out, start=1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), number)
    os.environ.clear()
    os.environ.update(env)
    os.chdir(folder)
    sys.argv = [module, *arguments]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


@contextmanager
def server() -> Iterator[None]:
    """The process that is forked; it ends with the block."""
    multiprocessing.set_forkserver_preload([__name__])
    paths = os.pathsep.join([str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    with mock.patch.dict(os.environ, ONE_THREAD | {"PYTHONPATH": paths}):
        forkserver.ensure_running()
    try:
        yield
    finally:
        forkserver._forkserver._stop()
