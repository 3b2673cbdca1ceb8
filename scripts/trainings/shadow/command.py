"""Train the network that tells shadow from dark ground (strategy `shadow`) on rendered scenes with exact truth.

Renders --blocks blocks of trainings.blocks (a city and a suburb are left out and only measured), trains a small U-Net
for --steps steps on random pieces of them and writes its weights, batch normalisation folded in, as float16
safetensors for aeromatch_cli/nets/shadow.py.

Since truth says how much of the sun each pixel lacks, materials and light are changed apart: dark materials and greens
made darker, patches and strips of other albedo painted over sun and shadow alike, shadow weakened or taken away as by
clouds; then every piece is developed anew (exposure, gamma, contrast curve, white balance, saturation, haze, blur,
noise, gray). So darkness alone (roofs, asphalt, forest, water) is no evidence of shadow.

One core renders a block in half a minute and trains 6,000 steps in half an hour. OUT/blocks and OUT/state.pt are kept:
a killed run goes on where it was. Writes OUT/shadow.safetensors and OUT/log.json (loss, IoU on what was
left out).
"""

from __future__ import annotations

import argparse
import copy
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from aeromatch_cli.lab.synthetic.light import Light
from aeromatch_cli.lab.synthetic.write import depth_path, read_raster, sun_path
from aeromatch_cli.strategies.enhancers.shadow_mask import Overview, network_inputs
from aeromatch_cli.strategies.enhancers.tone import Tone
from trainings.blocks import IMAGES, LEFT_OUT, render
from trainings.runs import at_least_one, check_recipe, load_state, save_state

WIDTHS = (16, 24, 40, 56, 64)
PIECE_PX, BATCH = 160, 12
SCALES = (0.5, 1.3)  # of the rendered pictures
DECAY = 0.997
SKY = 2
Piece = tuple[NDArray[np.float32], NDArray[np.uint8]]


@dataclass(frozen=True, eq=False)
class Picture:
    """pixels: (H, W, 3) RGB. labels: (H, W) 0 lit, 1 shadow, 2 sky. sun: (H, W) uint8, 255 times the sun's share.
    ratio: (3,) light of level ground in the sun over that in shadow."""

    pixels: NDArray[np.uint8]
    labels: NDArray[np.uint8]
    sun: NDArray[np.uint8]
    ratio: NDArray[np.float32]


def read_block(folder: Path) -> list[Picture]:
    """All pictures of a block."""
    facts = json.loads((folder / "synth.json").read_text(encoding="utf-8"))
    lights = [Light(**light) for light in facts["lights"]]
    found = []
    for image in facts["images"]:
        name, light = image["name"], lights[image["sortie"]]
        pixels = cv2.cvtColor(cv2.imread(str(folder / "images" / name)), cv2.COLOR_BGR2RGB)
        sun = read_raster(sun_path(folder, name))
        labels = (sun < 128).astype(np.uint8)
        labels[~np.isfinite(read_raster(depth_path(folder, name)))] = SKY
        ratio = 1.0 + light.sun * light.to_sun[2] / light.indirect(np.ones((1, 1), np.float32))[0]
        found.append(Picture(pixels, labels, sun, ratio.astype(np.float32)))
    return found


def piece(picture: Picture, rng: np.random.Generator) -> Piece:
    """Network inputs (P, P, 3) and labels (P, P) of a random piece, turned, relit, repainted and developed anew."""
    height, width = picture.labels.shape
    side = min(int(PIECE_PX / np.exp(rng.uniform(*np.log(SCALES)))), height, width)
    y, x = int(rng.integers(height - side + 1)), int(rng.integers(width - side + 1))
    window, turns, flip = np.s_[y : y + side, x : x + side], int(rng.integers(4)), 1 if rng.random() < 0.5 else -1
    tone = Tone(1.0, linear=False)
    light, labels = relit(tone.light(picture.pixels[window] / np.float32(255.0)), picture, window, rng)
    size = (PIECE_PX, PIECE_PX)
    light = cv2.resize(light, size, interpolation=cv2.INTER_AREA if side > PIECE_PX else cv2.INTER_LINEAR)
    labels = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)
    light, labels = (np.rot90(array, turns)[:, ::flip] for array in (light, labels))
    levels = developed(repainted(light, rng), rng)
    overview = Overview(levels, np.ones(labels.shape, dtype=bool), tone.light(levels).mean(axis=2), tone)
    return network_inputs(overview), np.ascontiguousarray(labels)


def relit(
    light: NDArray[np.float32], picture: Picture, window: Any, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Light (S, S, 3) and labels (S, S) of a window of another world: the truth says how much of the sun each pixel
    lacks, so that materials and light can be changed apart.

    Materials: dark ones made darker, and greens, as real asphalt, grass and forest are. Light: in some cases
    no shadow at all, as under a veiled sun, in some weaker shadow.
    """
    labels, drawn = picture.labels[window], rng.random()
    share = picture.sun[window].astype(np.float32)[..., None] / np.float32(255.0)
    lacking = picture.ratio / (1.0 + (picture.ratio - 1.0) * share)
    lacking[labels == SKY] = 1.0
    in_sun = light * lacking
    brightness = in_sun.mean(axis=2, keepdims=True) + np.float32(1e-3)
    if rng.random() < 0.6:
        light = light * np.minimum(brightness / np.quantile(brightness, 0.8), 1.5) ** np.float32(rng.uniform(0.0, 1.0))
    if rng.random() < 0.6:
        red, green, blue = np.split(in_sun, 3, axis=2)
        leafy = np.clip((green - np.maximum(red, blue)) / (green + np.float32(1e-3)) * 5.0, 0.0, 1.0)
        light = light * np.exp(leafy * np.float32(rng.uniform(-1.5, 0.3)))
    if drawn >= 0.25:
        return light, labels
    weaker = 1.0 if drawn < 0.12 else rng.uniform(0.2, 0.7)
    lifted: NDArray[np.float32] = light * lacking ** np.float32(weaker)
    return lifted, np.where(labels == 1, 0, labels).astype(np.uint8) if drawn < 0.12 else labels


def repainted(light: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Light (P, P, 3) with strips and patches of another albedo, the same in sun and shadow."""
    if rng.random() < 0.4:
        return light
    factor = np.zeros(light.shape, dtype=np.float32)
    for _ in range(int(rng.integers(1, 6))):
        length = rng.uniform(60.0, 400.0) if rng.random() < 0.4 else rng.uniform(8.0, 60.0)
        box = cv2.boxPoints((rng.uniform(0, PIECE_PX, 2), (length, rng.uniform(5.0, 40.0)), rng.uniform(0.0, 180.0)))
        albedo = rng.uniform(-1.6, 0.4) + rng.normal(0.0, 0.15, 3)
        cv2.fillPoly(factor, [np.rint(box).astype(np.int32)], albedo.tolist())
    painted: NDArray[np.float32] = light * np.exp(cv2.GaussianBlur(factor, (0, 0), rng.uniform(0.3, 1.0)))
    return painted


def developed(light: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Stored levels (P, P, 3), 0-1 in steps of 1/255, of the light through another camera and air."""
    light = light * np.exp(rng.normal(0.0, 0.08, 3)).astype(np.float32)
    gray = light.mean(axis=2, keepdims=True)
    light = np.maximum(gray + (light - gray) * rng.uniform(0.5, 1.5), 0.0)
    if rng.random() < 0.3:
        haze = rng.uniform(0.0, 0.08)
        light = light * (1.0 - haze) + haze * rng.uniform(0.3, 1.0) * np.array([0.75, 0.95, 1.2])
    light = np.clip(light * np.exp(rng.uniform(np.log(0.2), np.log(1.8))), 0.0, 1.0)
    level = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.power(np.maximum(light, 1e-8), 1 / 2.4) - 0.055)
    level = np.clip(level, 0.0, 1.0) ** rng.uniform(0.75, 1.6)
    if rng.random() < 0.3:
        level = level + rng.uniform(0.0, 0.8) * (level * level * (3.0 - 2.0 * level) - level)
    if rng.random() < 0.3:
        level = cv2.GaussianBlur(level, (0, 0), rng.uniform(0.4, 1.2))
    level = level + rng.normal(0.0, rng.uniform(0.0, 0.015), level.shape)
    if rng.random() < 0.2:
        level = np.repeat(level.mean(axis=2, keepdims=True), 3, axis=2)
    return np.asarray(np.clip(np.rint(level * 255.0) / 255.0, 0.0, 1.0), dtype=np.float32)


class ConvBlock(nn.Sequential):
    def __init__(self, bands_in: int, bands_out: int) -> None:
        convolution = nn.Conv2d(bands_in, bands_out, 3, padding=1, bias=False)
        super().__init__(convolution, nn.BatchNorm2d(bands_out), nn.ReLU(inplace=True))


class ShadowNet(nn.Module):
    """What nets.shadow.shadow_logits evaluates, as it is trained."""

    def __init__(self) -> None:
        super().__init__()
        sides = list(zip((12, *WIDTHS), WIDTHS, strict=False))
        self.down = nn.ModuleList([nn.Sequential(ConvBlock(i, o), ConvBlock(o, o)) for i, o in sides])
        self.up = nn.ModuleList([ConvBlock(fine + coarse, fine) for fine, coarse in sides[1:]])
        self.out = nn.Conv2d(WIDTHS[0], 4, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = nn.functional.pixel_unshuffle(x, 2)
        skipped = []
        for scale, block in enumerate(self.down):
            x = block(nn.functional.max_pool2d(x, 2) if scale else x)
            skipped.append(x)
        for scale in reversed(range(len(self.up))):
            coarse = nn.functional.interpolate(x, scale_factor=2, mode="nearest")
            x = self.up[scale](torch.cat([skipped[scale], coarse], dim=1))
        return nn.functional.pixel_shuffle(self.out(x), 2)[:, 0]


def loss_of(logits: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
    """Cross entropy plus half the Dice loss, sky left out."""
    known, shadow = (labels != SKY).float(), (labels == 1).float()
    entropy = nn.functional.binary_cross_entropy_with_logits(logits, shadow, reduction="none")
    share = torch.sigmoid(logits)
    dice = 1.0 - 2.0 * (share * shadow * known).sum() / (((share + shadow) * known).sum() + 1.0)
    return (entropy * known).sum() / known.sum() + 0.5 * dice


def folded(net: ShadowNet) -> dict[str, NDArray[np.float16]]:
    """Weights as nets.shadow reads them: NAME.weight (9 * C_in, C_out), NAME.bias (C_out,)."""
    arrays: dict[str, Any] = {}
    named = [(f"down{i}.{j}", block[j]) for i, block in enumerate(net.down) for j in (0, 1)]
    for name, (convolution, norm, _) in named + [(f"up{i}", block) for i, block in enumerate(net.up)]:
        scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
        weight = convolution.weight * scale[:, None, None, None]
        arrays[f"{name}.weight"] = weight.permute(2, 3, 1, 0).reshape(-1, len(weight))
        arrays[f"{name}.bias"] = norm.bias - norm.running_mean * scale
    arrays["out.weight"], arrays["out.bias"] = net.out.weight[:, :, 0, 0].T, net.out.bias
    return {name: np.ascontiguousarray(array.detach().numpy().astype(np.float16)) for name, array in arrays.items()}


def left_out_iou(net: ShadowNet, pictures: list[Picture]) -> float:
    """Median IoU over the pictures with at least 5 % shadow, at 640 x 480."""
    net.eval()
    found = []
    tone = Tone(255.0, linear=False)
    for picture in pictures:
        labels, levels = picture.labels, picture.pixels.astype(np.float32) / np.float32(255.0)
        overview = Overview(levels, np.ones(labels.shape, dtype=bool), tone.light(levels).mean(axis=2), tone)
        with torch.no_grad():
            logits = net(torch.from_numpy(network_inputs(overview)).permute(2, 0, 1)[None])[0].numpy()
        shadow = cv2.resize(logits, labels.shape[::-1]) > 0.0
        shadow, truth = shadow & (labels != SKY), labels == 1
        if truth.mean() >= 0.05:
            found.append((shadow & truth).sum() / (shadow | truth).sum())
    net.train()
    return float(np.median(found))


def train(args: argparse.Namespace, known: list[Any], left_out: list[Any]) -> ShadowNet:
    """The moving average of the weights after all steps."""
    torch.manual_seed(0)
    net = ShadowNet()
    if args.start:
        net.load_state_dict(torch.load(args.start, weights_only=False)[3])
    average = copy.deepcopy(net)
    optimiser = torch.optim.AdamW(net.parameters(), args.rate, weight_decay=1e-4)
    state = args.out / "state.pt"
    first, log = load_state(state, net, average, optimiser)
    for step in range(first, args.steps):
        rng = np.random.default_rng([step, 1])
        for group in optimiser.param_groups:
            group["lr"] = (
                args.rate * min(1.0, (step + 1) / 100) * (0.5 + 0.5 * np.cos(np.pi * step / args.steps)) + 1e-5
            )
        drawn = [piece(known[int(rng.integers(len(known)))], rng) for _ in range(BATCH)]
        inputs = torch.from_numpy(np.stack([inputs for inputs, _ in drawn])).permute(0, 3, 1, 2)
        loss = loss_of(net(inputs), torch.from_numpy(np.stack([labels for _, labels in drawn])))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        keep = min(DECAY, (step + 1) / (step + 20))
        for old, new in zip(average.state_dict().values(), net.state_dict().values(), strict=True):
            if old.is_floating_point():
                old.mul_(keep).add_(new, alpha=1.0 - keep)
        if (step + 1) % 200 == 0:
            log.append({"step": step + 1, "loss": loss.item(), "left_out_iou": left_out_iou(average, left_out)})
            print(log[-1], flush=True)
            save_state(state, step + 1, log, net, average, optimiser)
    (args.out / "log.json").write_text(json.dumps(log, indent=1), encoding="utf-8")
    return average.eval()


def main(arguments: Sequence[str] | None = None) -> None:
    from safetensors.numpy import save_file

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=41, help=f"rendered blocks of {IMAGES} pictures, at least 19")
    parser.add_argument("--steps", type=at_least_one, default=6000)
    parser.add_argument("--rate", type=float, default=2e-3, help="learning rate, falls to nothing over the steps")
    parser.add_argument("--start", type=Path, metavar="STATE", help="state.pt of another run to start from")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args(arguments)
    check_recipe(parser, args, ("blocks", "steps", "rate", "start"))
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    folders = [render(args.out / "blocks", block_idx) for block_idx in range(args.blocks)]
    blocks = [read_block(folder) for folder in folders]
    known = [item for i, block in enumerate(blocks) if i not in LEFT_OUT for item in block]
    left_out = [item for i in LEFT_OUT for item in blocks[i]]
    net = train(args, known, left_out)
    save_file(folded(net), args.out / "shadow.safetensors")
