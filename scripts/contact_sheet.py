"""One picture of every rendered scene: from above, obliquely, and the city under two suns with its shadow truth."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from aeromatch_cli.synthetic import PRESETS, render_block
from aeromatch_cli.synthetic.write import sun_path

TILE_PX, COLUMNS = (400, 300), 4
# What shows the scene best beside the view from above: flight, pictures to plan, the one to show.
_OBLIQUE, _ORBIT = ("oblique", 5, 2), ("orbit", 6, 2)
SECOND = {"hills": _ORBIT, "water-edge": _ORBIT}


def tiles(folder: Path, width_px: int, seed: int, jobs: int) -> list[np.ndarray]:
    """Labelled pictures, row by row."""
    found = []
    for preset in PRESETS:
        for flight, images, number in (("nadir", 4, 2), SECOND.get(preset, _OBLIQUE)):
            out = render(folder, preset, flight, images, width_px, seed, jobs)
            found.append(tile(out / "images" / f"{preset}_{number:04d}.jpg", f"{preset}, {flight}"))
    out = render(folder, "city", "two-flights", 8, width_px, seed, jobs)
    found.append(tile(out / "images" / "city_0006.jpg", "city, second sortie"))
    found.append(tile(sun_path(out, "city_0006.jpg"), "its sunlight (truth)"))
    return found


def render(folder: Path, preset: str, flight: str, images: int, width_px: int, seed: int, jobs: int) -> Path:
    out = folder / f"{preset}-{flight}"
    size: dict[str, Any] = {"width_px": width_px, "height_px": width_px * 3 // 4}
    render_block(out, preset, seed=seed, images=images, flight=flight, jobs=jobs, **size)
    return out


def tile(path: Path, label: str) -> np.ndarray:
    small = cv2.resize(cv2.imread(str(path)), TILE_PX, interpolation=cv2.INTER_AREA)
    (width, height), _ = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)
    cv2.rectangle(small, (0, 0), (width + 12, height + 12), (0, 0, 0), cv2.FILLED)
    cv2.putText(small, label, (6, height + 6), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return small


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--width", type=int, default=1000, help="width of the rendered pictures, pixels")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=0, help="worker processes; 0 = one per core")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent.parent / ".assets" / "scenes.jpg")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        pictures = tiles(Path(folder), args.width, args.seed, args.jobs)
    rows = [np.hstack(pictures[k : k + COLUMNS]) for k in range(0, len(pictures), COLUMNS)]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(args.out), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 85])
    print(args.out)


if __name__ == "__main__":
    main()
