"""Cases of atheris for a reader (`scripts/fuzz --guided`): libFuzzer's mutations, led by the lines that they reach.

One process per reader, as libFuzzer ends its process.

Needs atheris, which has wheels for Linux alone: `pip install 'aeromatch[fuzz]'`.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
import traceback
from collections.abc import Iterator
from pathlib import Path

# The longest case, bytes: sound files are smaller.
_LONGEST = 1 << 16
_FAULTS = "faults.jsonl"


def guided_faults(reader: str, cases: int, seed: int, folder: Path) -> Iterator[tuple[str, bytes, str]]:
    """File name, content and what happened, of every case that ends in anything but the project's own errors.

    SystemExit where the process ends otherwise (out of memory, a crash of a library).
    """
    words = [sys.executable, __file__, reader, str(cases), str(seed), str(folder)]
    done = subprocess.run(words, check=False, capture_output=True, text=True, errors="replace")
    if done.returncode or "Done " not in done.stderr:
        raise SystemExit(f"{reader}: exit code {done.returncode}\n{done.stderr[-3000:]}")
    found = folder / _FAULTS
    for line in found.read_text(encoding="utf-8").splitlines() if found.exists() else ():
        name, data, what = json.loads(line)
        yield name, data.encode("latin-1"), what


def _main(name: str, cases: int, seed: int, scratch: Path) -> None:
    import atheris

    with atheris.instrument_imports(include=["aeromatch_cli"], enable_loader_override=False):
        from fuzzing import SLOWEST_S, readers

        from aeromatch_cli.errors import AeromatchError
    reader = readers()[name]
    names = sorted(reader.sound)
    corpus, folder = scratch / "corpus", scratch / "files"
    corpus.mkdir()
    for k, file in enumerate(names):
        (corpus / str(k)).write_bytes(bytes([k]) + reader.sound[file])
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(reader.sound[file])

    def note(file: str, data: bytes, what: str) -> None:
        with (scratch / _FAULTS).open("a", encoding="utf-8") as stream:
            stream.write(json.dumps([file, data.decode("latin-1"), what]) + "\n")

    def one_case(data: bytes) -> None:
        """The first byte chooses the file, the others are its contents."""
        file = names[data[0] % len(names)] if data else names[0]
        (folder / file).write_bytes(data[1:])
        started = time.process_time()
        try:
            with contextlib.suppress(AeromatchError):
                reader.read(folder / file)
        except Exception:  # noqa: BLE001 - this is what is looked for
            note(file, data[1:], traceback.format_exc(limit=-3))
        if (took := time.process_time() - started) > SLOWEST_S:
            note(file, data[1:], f"took {took:.0f} s of the processor")
        (folder / file).write_bytes(reader.sound[file])  # others may be read with it

    atheris.Setup(
        [sys.argv[0], f"-runs={cases}", f"-seed={seed + 1}", f"-max_len={_LONGEST}", "-rss_limit_mb=4096", str(corpus)],
        one_case,
    )
    atheris.Fuzz()


if __name__ == "__main__":
    _main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
