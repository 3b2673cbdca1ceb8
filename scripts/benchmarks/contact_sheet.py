"""One picture of every rendered scene: from above, obliquely, and the city under two suns with its shadow truth."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from aeromatch_cli.lab.synthetic import PRESETS
from aeromatch_cli.lab.synthetic.write import sun_path
from benchmarks import options
from benchmarks.scenes import render_once
from benchmarks.stamps import REPOSITORY

TILE_PX, COLUMNS = (400, 300), 4
# What shows the scene best beside the view from above: flight, pictures to plan, the one to show.
_OBLIQUE, _ORBIT = ("oblique", 5, 2), ("orbit", 6, 2)
SECOND = {"hills": _ORBIT, "water-edge": _ORBIT}


def tiles(folder: Path, width_px: int, seed: int, jobs: int) -> list[np.ndarray]:
    """Labelled pictures, row by row."""

    def render(preset: str, flight: str, images: int) -> Path:
        size = {"width_px": width_px, "height_px": width_px * 3 // 4, "images": images}
        return render_once(folder, preset, jobs=jobs, seed=seed, flight=flight, **size)

    found = []
    for preset in PRESETS:
        for flight, images, number in (("nadir", 4, 2), SECOND.get(preset, _OBLIQUE)):
            out = render(preset, flight, images)
            found.append(tile(out / "images" / f"{preset}_{number:04d}.jpg", f"{preset}, {flight}"))
    out = render("city", "two-flights", 8)
    found.append(tile(out / "images" / "city_0006.jpg", "city, second sortie"))
    found.append(tile(sun_path(out, "city_0006.jpg"), "its sunlight (truth)"))
    return found


def tile(path: Path, label: str) -> np.ndarray:
    small = cv2.resize(cv2.imread(str(path)), TILE_PX, interpolation=cv2.INTER_AREA)
    (width, height), _ = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)
    cv2.rectangle(small, (0, 0), (width + 12, height + 12), (0, 0, 0), cv2.FILLED)
    cv2.putText(small, label, (6, height + 6), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return small


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("scenes", __doc__)
    add = parser.add_argument
    add("--width", type=options.positive, default=1000, help="width of the rendered pictures, pixels")
    add("--seed", type=int, default=0)
    add("--jobs", type=int, default=0, help="worker processes; 0 = one per core")
    add("--out", type=Path, default=REPOSITORY / ".assets" / "scenes.jpg")
    args = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        pictures = tiles(Path(folder), args.width, args.seed, args.jobs)
    rows = [np.hstack(pictures[k : k + COLUMNS]) for k in range(0, len(pictures), COLUMNS)]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(args.out), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 85])
    print(args.out)
