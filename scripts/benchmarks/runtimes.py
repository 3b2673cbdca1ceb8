"""The networks on a CPU by several runtimes: milliseconds, and how equal their answers are to PyTorch's.

Runtimes: PyTorch as the program uses it, torch.compile, ONNX Runtime and OpenVINO, all float32; ONNX Runtime with 8-bit
integers (static, per channel, calibrated on another image). Those that are not installed are left out: `pip install
onnx onnxscript onnxruntime openvino`. Each thread count is a process of its own. Inputs are of two overlapping images
of a rendered suburb: a piece of the picture as the detector takes it, a batch of patches, and --keypoints SIFT
descriptors of either side, all layers of LightGlue. Milliseconds: median of --repeats calls after one that does not
count.

Equal answers: of the 500 highest maxima of the heat within 1 px of those of PyTorch; directions within 5 degrees;
descriptors with a cosine of 0.99 and more; of the mutual best pairs the same.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from aeromatch_cli.data import Camera, Features, View
from aeromatch_cli.lab.synthetic.block import render_block
from aeromatch_cli.nets.detector import PIECE_PX, REACH_PX, Detector, evened, load_detector
from aeromatch_cli.nets.files import SHIPPED_LIGHTGLUE
from aeromatch_cli.nets.geodesc import load_geodesc
from aeromatch_cli.nets.lightglue import LightGlue, Side
from aeromatch_cli.nets.orientation import load_orientation
from aeromatch_cli.nets.patches import BATCH, SIDE_PX
from aeromatch_cli.strategies import ViewPixels
from aeromatch_cli.strategies.extractors.sift import Sift
from aeromatch_cli.strategies.matchers.lightglue.inference import NetworkOptions, loaded_network, network_input
from benchmarks import options, stamps
from benchmarks.processes import fresh_process, limit_threads, median_seconds
from benchmarks.tables import Row, code, factor, markdown, number, percent, write_rows

_SIZE_PX = (1000, 750)
_STRONGEST = 500

Arrays = tuple[NDArray[np.float32], ...]
Call = Callable[[Arrays], Arrays]


@dataclass(frozen=True, eq=False)
class Case:
    """A network, an input to measure with, one to calibrate with, and the share of equal answers."""

    name: str
    network: nn.Module
    given: Arrays
    calibration: Arrays
    equal: Callable[[Arrays, Arrays], float]


class Layers(nn.Module):
    """Of the detector, without what evens the picture."""

    def __init__(self, detector: Detector) -> None:
        super().__init__()
        self.detector = detector

    def forward(self, picture: Tensor) -> Tensor:
        return self.detector._layered(picture)


class Pair(nn.Module):
    """All layers of LightGlue on one pair, then the last similarity (M, N)."""

    def __init__(self, network: LightGlue) -> None:
        super().__init__()
        self.network = network

    def forward(self, places0: Tensor, descriptors0: Tensor, places1: Tensor, descriptors1: Tensor) -> Tensor:
        *_, (x0, x1) = self.network.states(Side(places0, descriptors0), Side(places1, descriptors1))
        return self.network.assignment(len(self.network.layers) - 1).similarity(x0, x1)[0]


def cases(folder: Path, keypoints: int, seed: int) -> Iterator[Case]:
    """Each network with inputs of the first image, calibrated on the last one."""
    import cv2

    width, height = _SIZE_PX
    render_block(folder, "suburb", seed=seed, width_px=width, height_px=height, images=3)
    pictures = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted((folder / "images").iterdir())]
    grays = [evened(torch.from_numpy(p).float()[None, None] / 255.0).numpy() for p in pictures]
    side = PIECE_PX + 2 * REACH_PX
    first, last = (np.ascontiguousarray(gray[..., :side, :side]) for gray in (grays[0], grays[-1]))
    yield Case("detector", Layers(load_detector(precision="float32")), (first,), (last,), _equal_maxima)
    rng = np.random.default_rng(seed)
    patches = [_patches(picture, rng) for picture in (pictures[0], pictures[-1])]
    orientation, geodesc = load_orientation(precision="float32"), load_geodesc(precision="float32")
    within = float(np.cos(np.deg2rad(5.0)))
    yield Case("orientation", orientation, (patches[0],), (patches[1],), lambda a, b: _share(a, b, within))
    yield Case("GeoDesc", geodesc, (patches[0],), (patches[1],), lambda a, b: _share(a, b, 0.99))
    loaded = loaded_network(NetworkOptions(str(SHIPPED_LIGHTGLUE), "float32", "cpu", 0.1, -1.0, -1.0))
    sides = [_side(loaded, _features(picture, keypoints), keypoints) for picture in pictures]
    yield Case("LightGlue", Pair(loaded.network), (*sides[0], *sides[1]), (*sides[1], *sides[2]), _equal_pairs)


def _patches(picture: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.float32]:
    """(BATCH, 1, SIDE_PX, SIDE_PX) at random places."""
    xs, ys = (rng.integers(0, length - SIDE_PX, BATCH) for length in picture.shape[::-1])
    found = [picture[y : y + SIDE_PX, x : x + SIDE_PX] for x, y in zip(xs, ys, strict=True)]
    return np.stack(found)[:, None].astype(np.float32)


def _features(picture: NDArray[np.uint8], keypoints: int) -> Features:
    height, width = picture.shape
    camera = Camera("PINHOLE", width, height, (float(width), float(width), width / 2, height / 2))
    view = View("source", width, height, np.eye(3), False, 0.0)
    return Sift(keypoints=keypoints)(camera, [ViewPixels(view, picture, np.ones(picture.shape, bool))])


def _side(loaded: Any, features: Features, keypoints: int) -> Arrays:
    everything = np.ones(len(features.keypoints_px), bool)
    side = loaded._tensors(network_input(features, 0, everything, keypoints))
    return side.places.numpy(), side.descriptors.numpy()


def _equal_maxima(answer: Arrays, right: Arrays) -> float:
    found, wanted = (_maxima(heat[0][0, 0]) for heat in (answer, right))
    distances = np.abs(found[:, None] - wanted[None]).max(axis=2)
    return float((distances.min(axis=1) <= 1.0).mean())


def _maxima(heat: NDArray[np.float32]) -> NDArray[np.int64]:
    """(_STRONGEST, 2) rows and columns of the highest of those that are highest within 3 x 3 pixels."""
    import cv2

    peaks = np.where(heat >= cv2.dilate(heat, np.ones((3, 3))), heat, -np.inf)
    order = np.argsort(peaks, axis=None, kind="stable")[::-1][:_STRONGEST]
    return np.column_stack(np.unravel_index(order, heat.shape))


def _share(answer: Arrays, right: Arrays, least: float) -> float:
    """Of unit vectors (N, D) those whose cosine with the right ones is at least so large."""
    return float(((answer[0] * right[0]).sum(axis=1) >= least).mean())


def _equal_pairs(answer: Arrays, right: Arrays) -> float:
    found, wanted = (_mutual(one[0]) for one in (answer, right))
    return len(found & wanted) / max(1, len(wanted))


def _mutual(similarity: NDArray[np.float32]) -> set[tuple[int, int]]:
    best0, best1 = similarity.argmax(axis=1), similarity.argmax(axis=0)
    return {(row, int(column)) for row, column in enumerate(best0) if best1[column] == row}


# --- runtimes -----------------------------------------------------------------------------------------------------


def torch_call(case: Case, threads: int, folder: Path) -> Call:
    """As the program runs it."""
    del threads, folder
    return lambda given: (case.network(*map(torch.from_numpy, given)).numpy(),)


def compiled_call(case: Case, threads: int, folder: Path) -> Call:
    """torch.compile with its own compiler."""
    del threads, folder
    compiled = torch.compile(case.network)
    return lambda given: (compiled(*map(torch.from_numpy, given)).numpy(),)


def onnx_call(case: Case, threads: int, folder: Path) -> Call:
    """ONNX Runtime, float32."""
    return _session(_exported(case, folder), threads)


def onnx_int8_call(case: Case, threads: int, folder: Path) -> Call:
    """ONNX Runtime, weights and activations in 8 bits."""
    from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static

    source = _exported(case, folder)

    class Reader(CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self.left = [dict(zip(_inputs(source), case.calibration, strict=True))]

        def get_next(self) -> Mapping[str, Any] | None:
            return self.left.pop() if self.left else None

    target = folder / f"{case.name}.int8.onnx"
    quantize_static(source, target, Reader(), per_channel=True, weight_type=QuantType.QInt8)
    return _session(target, threads)


def openvino_call(case: Case, threads: int, folder: Path) -> Call:
    """OpenVINO, float32."""
    import openvino

    core = openvino.Core()
    known = {"INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": "f32", "NUM_STREAMS": 1}
    model = core.compile_model(core.read_model(_exported(case, folder)), "CPU", known)
    return lambda given: (model(list(given))[0],)


# Name -> how a network is called by it, and the packages that it needs.
RUNTIMES: Mapping[str, tuple[Callable[[Case, int, Path], Call], tuple[str, ...]]] = {
    "torch": (torch_call, ()),
    "torch.compile": (compiled_call, ()),
    "onnxruntime": (onnx_call, ("onnx", "onnxscript", "onnxruntime")),
    "onnxruntime int8": (onnx_int8_call, ("onnx", "onnxscript", "onnxruntime")),
    "openvino": (openvino_call, ("onnx", "onnxscript", "openvino")),
}


def _exported(case: Case, folder: Path) -> Path:
    path = folder / f"{case.name}.onnx"
    if not path.is_file():
        torch.onnx.export(case.network, tuple(map(torch.from_numpy, case.given)), path, dynamo=True, verbose=False)
    return path


def _inputs(path: Path) -> list[str]:
    import onnx

    return [found.name for found in onnx.load(path, load_external_data=False).graph.input]


def _session(path: Path, threads: int) -> Call:
    import onnxruntime

    wanted = onnxruntime.SessionOptions()
    wanted.intra_op_num_threads = threads
    session = onnxruntime.InferenceSession(path, wanted, providers=["CPUExecutionProvider"])
    names = [found.name for found in session.get_inputs()]
    return lambda given: (session.run(None, dict(zip(names, given, strict=True)))[0],)


# --- the table ----------------------------------------------------------------------------------------------------


def measured(folder: Path, threads: int, keypoints: int, repeats: int, seed: int) -> list[Row]:
    """Of every network and every runtime that is installed."""
    torch.set_num_threads(threads)
    logging.disable(logging.WARNING)  # the exporter's remarks on packages that these networks do not need
    warnings.simplefilter("ignore")
    rows: list[Row] = []
    with torch.inference_mode():
        for case in cases(folder / "block", keypoints, seed):
            right: Arrays = ()
            for name, (made, needs) in RUNTIMES.items():
                if any(find_spec(package) is None for package in needs):
                    continue
                call = made(case, threads, folder)
                seconds, answer = median_seconds(partial(call, case.given), repeats)
                right = right or answer
                rows.append(
                    {"network": case.name, "runtime": name, "threads": threads, "ms": 1e3 * seconds,
                     "equal": case.equal(answer, right)}
                )  # fmt: skip
                print(rows[-1], flush=True)
    return rows


def table_of(rows: Sequence[Row]) -> str:
    base = {(row["network"], row["threads"]): row["ms"] for row in rows if row["runtime"] == "torch"}
    lines = [
        (
            row["network"], row["threads"], code(row["runtime"]), number(row["ms"], 1),
            factor(row["ms"] / base[row["network"], row["threads"]]), percent(row["equal"], 1),
        )
        for row in sorted(rows, key=lambda row: (row["network"], row["threads"]))
    ]  # fmt: skip
    return markdown(("network", "threads", "runtime", "ms", "of PyTorch", "equal answers"), lines)


def main(arguments: Sequence[str]) -> None:
    parser = options.make_parser("runtimes", __doc__)
    add = parser.add_argument
    add("--threads", type=options.numbers, default="1,2", help="comma-separated")
    add("--keypoints", type=options.positive, default=2048, help="of either side of LightGlue")
    add("--repeats", type=options.positive, default=7)
    add("--seed", type=int, default=0)
    options.add_output(parser)
    args = options.parse(parser, arguments, {"threads": "1", "keypoints": "200", "repeats": "1"})
    args.out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for threads in args.threads:
        with fresh_process(1, limit_threads, threads) as pool:
            rows += pool.submit(measured, args.out, threads, args.keypoints, args.repeats, args.seed).result()
        write_rows(args.out / "runtimes.json", rows)
    options.publish(
        args, table_of(rows) + "\n",
        args.out / "runtimes.md", table="bench_runtimes", command=options.command_line(parser, args),
        versions=stamps.of_networks("detector", "orientation", "geodesc", "lightglue"),
    )  # fmt: skip
