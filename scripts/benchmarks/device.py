"""Images and pairs per second of the networks on a CUDA device, and how far that is from what the device can do.

Work is counted in multiplications and additions (torch.utils.flop_counter). The limit is what the device itself reaches
in a bfloat16 product of two matrices of 8192 x 8192 in the same run. Rates: median of --repeats calls after one that
does not count, everything in memory. `learned, whole` is the extractor as a run calls it: pyramid, maxima, patches and
the even spread run on one core of the processor; beside it the same without a device. LightGlue: --batch pairs of 2048
random descriptors a side, no early exit, as hard as it can be.

The device may be on a machine that has no clone of the repository: OUT/device.json comes back, and
`--rows FILE --docs` makes the table of it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from aeromatch_cli.data import Camera, View
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.nets.detector import load_detector
from aeromatch_cli.nets.files import SHIPPED_LIGHTGLUE
from aeromatch_cli.nets.geodesc import load_geodesc
from aeromatch_cli.nets.lightglue import Side
from aeromatch_cli.nets.lightglue_batch import match_batch
from aeromatch_cli.nets.lightglue_file import load_lightglue
from aeromatch_cli.nets.precision import layer_type
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.learned import Learned
from benchmarks import options, stamps
from benchmarks.memory import texture
from benchmarks.processes import median_seconds
from benchmarks.tables import Row, markdown, number, percent, write_rows

KEYPOINTS, PATCHES, SIDE = 2048, 8192, 8192


def limit_flops(repeats: int) -> float:
    """Multiplications and additions a second in a bfloat16 matrix product."""
    one, other = (torch.randn(SIDE, SIDE, device="cuda", dtype=torch.bfloat16) for _ in range(2))
    return 2.0 * SIDE**3 / median_seconds(lambda: one @ other, repeats, "cuda")[0]


def _flops(call: Callable[[], object]) -> float:
    from torch.utils.flop_counter import FlopCounterMode

    with FlopCounterMode(display=False) as counter:
        call()
    return float(counter.get_total_flops())


def network_calls(gray: Any, batch: int) -> Iterator[tuple[str, str, int, Callable[[], object]]]:
    """Name, what is counted, how many of them a call does, and the call."""
    detector, geodesc = load_detector(device="cuda"), load_geodesc(device="cuda")
    picture = torch.from_numpy(gray).cuda().float()[None, None] / 255.0
    patches = torch.rand(PATCHES, 1, 32, 32, device="cuda")
    lightglue = load_lightglue(SHIPPED_LIGHTGLUE, device="cuda").with_layers_in(layer_type("auto", "cuda"))
    generator = torch.Generator("cuda").manual_seed(0)

    def side() -> Side:
        places = torch.rand(1, KEYPOINTS, 4, device="cuda", generator=generator) * 2.0 - 1.0
        descriptors = torch.rand(1, KEYPOINTS, 128, device="cuda", generator=generator)
        return Side(places, descriptors / descriptors.norm(dim=-1, keepdim=True))

    sides = [[side() for _ in range(batch)] for _ in range(2)]
    everything = {"threshold": 0.1, "depth_confidence": -1.0, "width_confidence": -1.0}
    yield "detector", "images", 1, lambda: detector(picture)
    yield "GeoDesc", "patches", PATCHES, lambda: geodesc(patches)
    yield "LightGlue", "pairs", batch, lambda: match_batch(lightglue, *sides, **everything)


def whole_call(gray: Any, device: str) -> Callable[[], object]:
    """The learned extractor on one north-up view of the picture (H, W)."""
    height, width = gray.shape
    view = View("source", width, height, np.eye(3), True, 0.0)
    camera = Camera("PINHOLE", width, height, (float(width), float(width), width / 2, height / 2))
    extractor = Learned(keypoints=4000, device=device)
    pixels = ViewPixels(view, gray, np.ones(gray.shape, bool))
    return lambda: extractor(camera, [pixels])


def measured(args: Any) -> list[Row]:
    """Rates, and of the networks alone their share of the limit."""
    width, height = args.size
    gray = texture(width, height, args.seed)
    limit = limit_flops(args.repeats)
    device = torch.cuda.get_device_name()
    rows: list[Row] = [{"part": "limit", "device": device, "tflops": limit / 1e12}]
    with torch.inference_mode():
        for name, unit, count, call in network_calls(gray, args.batch):
            seconds = median_seconds(call, args.repeats, "cuda")[0]
            rate = _flops(call) / seconds
            rows.append(
                {"part": name, "device": device, "unit": unit, "rate": count / seconds, "tflops": rate / 1e12,
                 "of_limit": rate / limit}
            )  # fmt: skip
            print(rows[-1], flush=True)
    for where in ("cuda", "cpu"):
        seconds = median_seconds(whole_call(gray, where), args.repeats if where == "cuda" else 1, "cuda")[0]
        rows.append({"part": "learned, whole", "device": where, "unit": "images", "rate": 1.0 / seconds})
        print(rows[-1], flush=True)
    return rows


def table_of(rows: Sequence[Row], size: tuple[int, int]) -> str:
    head, *others = rows
    lines = [
        (
            row["part"], head["device"] if row["device"] in ("cuda", head["device"]) else "processor",
            f"{number(row['rate'], 1)} {row['unit']}", number(row["tflops"], 1) if "tflops" in row else "-",
            percent(row["of_limit"], 1) if "of_limit" in row else "-",
        )
        for row in others
    ]  # fmt: skip
    said = f"Limit: {head['tflops']:.0f} TFLOP/s of {head['device']}. Images of {size[0]} x {size[1]}.\n\n"
    return said + markdown(("part", "on", "a second", "TFLOP/s", "of the limit"), lines)


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("device", __doc__)
    add = parser.add_argument
    add("--size", type=options.size_px, metavar="WxH", default="2000x1500")
    add("--batch", type=options.positive, default=16, help="pairs at once")
    add("--repeats", type=options.positive, default=10)
    add("--seed", type=int, default=0)
    add("--rows", type=Path, help="device.json of another machine: measure nothing, make its table")
    options.add_output(parser)
    args = options.parse(parser, arguments, {"size": "640x480", "repeats": "2"})
    args.out.mkdir(parents=True, exist_ok=True)
    if args.rows is not None:
        rows = json.loads(args.rows.read_text(encoding="utf-8"))
    elif torch.cuda.is_available():
        rows = measured(args)
        write_rows(args.out / "device.json", rows)
    else:
        raise ConfigError("torch sees no CUDA device on this machine; --rows takes the results of another one")
    options.publish(
        args, table_of(rows, args.size) + "\n", args.out / "device.md", table="bench_device",
        command=options.command_line(parser, args, size="{}x{}".format(*args.size)),
        versions=stamps.of_networks("detector", "geodesc", "lightglue"),
    )  # fmt: skip
