"""Processes of their own for pycolmap, since it stops the whole process on a fault: `python -m MODULE FOLDER`."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import zlib
from pathlib import Path
from types import ModuleType

from aeromatch_cli.errors import InputError, tells_of_memory
from aeromatch_cli.workers import ONE_THREAD

# COLMAP passes over cameras with a distortion parameter beyond 1, unless told otherwise. Long lenses have such: the
# parameters of equal distortions grow with powers of the focal length.
ANY_DISTORTION = 1e9


def run_process(module: str, folder: Path, result: str, what: str) -> Path:
    """Return the file `result` that a module of this package makes in `folder`.

    Raises MemoryError where it ends for lack of memory, InputError, naming `what`, where it stops otherwise: only the
    latter says something of the block.
    """
    command = [sys.executable, "-m", f"aeromatch_cli.sfm.{module}", str(folder)]
    environment = {**os.environ, **ONE_THREAD}  # whatever ran before in this process
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=environment)
    if done.returncode == -signal.SIGKILL or tells_of_memory(done.stderr):
        raise MemoryError(f"{what} ended for lack of memory")
    if done.returncode or not (folder / result).is_file():
        said = " ".join((done.stderr or done.stdout).strip().splitlines()[-1:])
        raise InputError(f"{what} {_ended(done.returncode)}" + (f": {said}" if said else ""))
    return folder / result


def _ended(code: int) -> str:
    """How a process has ended, in words. code: negative where a signal ended it."""
    if code >= 0:
        return f"stopped with exit code {code}"
    return f"was ended by signal {-code} ({signal.strsignal(-code) or 'unknown'})"


def quiet_pycolmap() -> ModuleType:
    """Import pycolmap without its log, in the child process."""
    zlib.compress(b"")  # pycolmap aborts when it is the first user of zlib
    import pycolmap

    pycolmap.logging.minloglevel = 3
    return pycolmap
