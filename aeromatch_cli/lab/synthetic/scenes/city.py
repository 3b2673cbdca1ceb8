"""A dense city: rows of houses around yards, slabs, towers, halls and parks in a net of streets."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.covers import MARKING, asphalt, gravel, lawn, slabs, worn
from aeromatch_cli.lab.synthetic.noise import inside, stripes
from aeromatch_cli.lab.synthetic.paint import Painted, Samples, mix, rgb
from aeromatch_cli.lab.synthetic.rasters import look_up
from aeromatch_cli.lab.synthetic.scenes import Plan, SceneKind
from aeromatch_cli.lab.synthetic.scenes.city_blocks import PAVED_YARDS, Layout, Use, build_block, is_red, layout
from aeromatch_cli.lab.synthetic.scenes.streets import Block, blocks_near, left_of, street_map
from aeromatch_cli.lab.synthetic.solids import Footprint, Surface, turned
from aeromatch_cli.lab.synthetic.terrain import Area, Flat

# Layers of the ground map, metres where not stated; see StreetMap. lawn: distance inside a lawn. half: half width of
# the street. tone: 0-1, the block's own; below zero where its pavements are red.
_KERB, _SIDE, _ALONG, _END, _PLOT, _LAWN, _HALF, _TONE = range(8)
_WIDE_M = 7.0  # streets of four lanes are wider than this from their axis, all others narrower


def plan_city(seed: int, area: Area) -> Plan:
    """All blocks whose middle is in the area."""
    heading_deg = float(np.random.default_rng([seed, 1]).uniform(5.0, 85.0))
    reach = np.array([[area.x0_m, area.y0_m], [area.x1_m, area.y0_m], [area.x1_m, area.y1_m], [area.x0_m, area.y1_m]])
    uv = Footprint(0.0, 0.0, 1.0, 1.0, -heading_deg).at(reach)
    surfaces: list[Surface] = []
    counts: Counter[str] = Counter()
    frame = Footprint(0.0, 0.0, 1.0, 1.0, heading_deg)
    for block in blocks_near(seed, *uv.min(axis=0), *uv.max(axis=0)):
        x, y = frame.at(block.corners_uv.mean(axis=0)[None])[0]
        if area.contains(float(x), float(y)):
            stock = build_block(seed, block)
            surfaces += stock.surfaces
            counts += stock.counts
    return Plan(Flat(), heading_deg, turned(surfaces, heading_deg), dict(counts))


def draw_ground(seed: int, u_m: FloatArray, v_m: FloatArray) -> NDArray[np.float32]:
    """Layers (H, W, 8) at points (H, W) of the plan."""
    layers = np.zeros((*u_m.shape, 8), dtype=np.float32)
    layers[..., _KERB], layers[..., _PLOT], layers[..., _LAWN] = -5.0, -9.0, -9.0
    step = u_m[0, 1] - u_m[0, 0]
    for block in blocks_near(seed, u_m[0, 0], v_m[0, 0], u_m[-1, -1], v_m[-1, -1]):
        lo, hi = block.corners_uv.min(axis=0), block.corners_uv.max(axis=0)
        c0, c1 = (
            int(np.clip(np.floor((u - u_m[0, 0]) / step) + k, 0, u_m.shape[1])) for u, k in ((lo[0], 0), (hi[0], 2))
        )
        r0, r1 = (
            int(np.clip(np.floor((v - v_m[0, 0]) / step) + k, 0, u_m.shape[0])) for v, k in ((lo[1], 0), (hi[1], 2))
        )
        if c0 >= c1 or r0 >= r1:
            continue
        window = (slice(r0, r1), slice(c0, c1))
        uv = np.column_stack([u_m[window].ravel(), v_m[window].ravel()])
        own, here = street_map(block, uv)
        kept = layout(seed, *block.key)
        half = np.array([side.half_m for side in block.sides])[here.street]
        tone = np.full(len(uv), -0.05 - kept.tone if is_red(seed, block) else 0.05 + kept.tone)
        drawn = np.column_stack(
            [here.kerb_m, here.side_m, here.along_m, here.end_m, here.plot_m,
             _lawn_m(block, kept, uv, here.plot_m), half, tone]
        )  # fmt: skip
        patch = layers[window].reshape(-1, 8)
        patch[own] = drawn[own]
        layers[window] = patch.reshape(*u_m[window].shape, 8)
    return layers


def _lawn_m(block: Block, kept: Layout, uv_m: FloatArray, plot_m: FloatArray) -> FloatArray:
    """Distance (N,) inside the lawns of a block, negative on its paths and yards."""
    if kept.use is Use.ROWS:
        return plot_m - kept.depth_m - 2.0 - 4.0 * kept.tone if kept.green > PAVED_YARDS else np.full(len(plot_m), -9.0)
    if kept.use is Use.HALLS:
        return np.minimum(1.2 - plot_m, plot_m - 0.1)
    corners = block.plot_uv()
    center = corners.mean(axis=0) + 6.0 * np.array([kept.green - 0.5, kept.tone - 0.5])
    paths_m = np.full(len(uv_m), 1e3)
    if kept.use is Use.PARK:
        paths_m = np.abs(np.linalg.norm(uv_m - center, axis=1) - 7.0 - 4.0 * kept.tone) - 1.3
        ends = corners if kept.green > 0.4 else 0.5 * (corners + np.roll(corners, -1, axis=0))
        for end in ends:
            paths_m = np.minimum(paths_m, _segment_m(center, end, uv_m) - 1.2)
        return np.minimum(plot_m - 1.0, paths_m)
    lawn = plot_m - (0.6 if kept.use is Use.SLABS else 5.0)
    for plan in kept.free:
        own = np.abs(Footprint(0.0, 0.0, 1.0, 1.0, -plan.heading_deg).at(uv_m - [plan.x_m, plan.y_m]))
        beyond = own - 0.5 * np.array([plan.length_x_m, plan.length_y_m])
        wall_m = np.linalg.norm(np.clip(beyond, 0.0, None), axis=1) + np.clip(beyond.max(axis=1), None, 0.0)
        lawn = np.minimum(lawn, wall_m - 1.0)
        way_m = np.abs(wall_m - 5.0) - 1.4 if kept.use is Use.SLABS else wall_m - 7.0
        lawn = np.minimum(lawn, way_m)
    for k in kept.parked:
        lawn = np.minimum(lawn, np.abs(left_of(corners[k], corners[(k + 1) % 4], uv_m) - 3.4) - 3.0)
    return np.minimum(lawn, _segment_m(corners[0], corners[2], uv_m) - 1.0)


def _segment_m(start: FloatArray, end: FloatArray, uv_m: FloatArray) -> FloatArray:
    along = end - start
    t = np.clip((uv_m - start) @ along / (along @ along), 0.0, 1.0)
    distance: FloatArray = np.linalg.norm(uv_m - start - t[:, None] * along, axis=1)
    return distance


def paint_city_ground(s: Samples) -> Painted:
    """Carriageways with markings, kerbs, pavements, and behind them yards, lawns and paths."""
    layers = look_up(draw_ground, s)
    kerb, plot = layers[:, _KERB], layers[:, _PLOT]
    colour = np.zeros((len(kerb), 3), dtype=np.float32)
    reach = 2.0 * s.footprint_m + 0.3
    for region, paint in (
        (kerb < reach, _street),
        ((kerb >= reach) & (plot < reach), _pavement),
        (plot >= reach, _yard),
    ):
        rows = np.flatnonzero(region)
        if len(rows):
            colour[rows] = paint(s.part(rows), layers[rows])
    edge = inside(0.05 - np.abs(plot), s.footprint_m)
    return Painted(mix(colour, rgb(0.15, 0.14, 0.125), 0.5 * edge))


def _street(s: Samples, layers: FloatArray) -> FloatArray:
    kerb, side, half = layers[:, _KERB], layers[:, _SIDE], layers[:, _HALF]
    lane = np.abs(side)
    # Wide streets are resurfaced more often. (Between two streets the map passes through all widths: keep it smooth.)
    age = np.clip(1.05 - 0.1 * half + 0.35 * s.broad, 0.0, 1.0)
    colour = asphalt(s, age)
    # Tyres polish two tracks in each lane; oil drips between them.
    track = np.cos(2.0 * np.pi * (lane - 0.75) / 1.55) * (lane < half - 1.6) * (layers[:, _END] > 0.0)
    colour = colour * (1.0 + 0.06 * track)[:, None]
    gutter = np.exp(-np.clip(-kerb, 0.0, None) / 0.25)
    colour = colour * (1.0 - 0.18 * gutter)[:, None]
    colour = mix(colour, rgb(*MARKING), _markings(s, layers) * worn(s))
    beyond = inside(kerb, s.footprint_m)
    colour = mix(colour, _pavement(s, layers), beyond)
    stone = inside(0.075 - np.abs(kerb - 0.075), s.footprint_m)
    return mix(colour, rgb(0.33, 0.325, 0.31), 0.75 * stone)


def _markings(s: Samples, layers: FloatArray) -> FloatArray:
    """Coverage (N,) by paint: centre lines, lanes, the edge of the parking lane, stop lines, zebras."""
    side, along, end, half = layers[:, _SIDE], layers[:, _ALONG], layers[:, _END], layers[:, _HALF]
    wide, lane, f = half > _WIDE_M, np.abs(side), s.footprint_m
    clear = inside(end - 5.0, f)
    dashes = stripes(along, 6.0, 3.0, f)
    center = np.where(wide, inside(0.06 - np.abs(lane - 0.16), f), inside(0.06 - lane, f) * dashes)
    center = center * ((half > 3.9) | wide)
    lanes = np.where(wide, inside(0.06 - np.abs(lane - 3.45), f) * dashes, 0.0)
    parking = inside(0.05 - np.abs(lane - half + 2.15), f) * ((half > 4.6) & ~wide)
    bays = stripes(along, 5.6, 0.1, f) * inside(1.0 - np.abs(lane - half + 1.1), f) * ((half > 5.2) & ~wide)
    stop = inside(0.2 - np.abs(end - 5.2), f) * inside(half - 0.4 - lane, f) * ((side > 0.0) ^ (along < 40.0))
    zebra = stripes(side, 1.0, 0.5, f) * inside(1.6 - np.abs(end - 2.0), f) * inside(half - 0.35 - lane, f)
    zebra = zebra * ((half > 4.3) | wide) * (end > -1.0)
    painted = np.maximum.reduce([center, lanes, parking, bays]) * clear
    return np.clip(np.maximum(np.maximum(painted, zebra), stop * (half > 4.3)), 0.0, 1.0)


def _pavement(s: Samples, layers: FloatArray) -> FloatArray:
    tone = layers[:, _TONE]
    red = np.clip(-tone * 1.2 + 0.1, 0.0, 1.0)
    colour = slabs(s, red)
    # Broad pavements have a cycle track of asphalt or a strip of cobbles at the kerb.
    strip = inside(0.45 - np.abs(layers[:, _KERB] - 0.6), s.footprint_m)
    return colour * (1.0 - 0.16 * strip * (1.0 + 0.6 * s.grain))[:, None]


def _yard(s: Samples, layers: FloatArray) -> FloatArray:
    """Asphalt, slabs or gravel, and lawns with ragged edges."""
    tone = np.abs(layers[:, _TONE])
    ragged = layers[:, _LAWN] + 0.10 * s.patch + 0.06 * s.grain
    green = np.clip(ragged / (2.0 * s.footprint_m + 0.12) + 0.5, 0.0, 1.0)
    colour = np.zeros((len(tone), 3), dtype=np.float32)
    for region, paint in (
        ((tone < 0.45) & (green < 1.0), lambda part, own: asphalt(part, np.clip(0.4 + own, 0.0, 1.0))),
        (
            (tone >= 0.45) & (tone < 0.8) & (green < 1.0),
            lambda part, own: slabs(part, np.clip(3.0 * own - 1.4, 0.0, 1.0)),
        ),
        ((tone >= 0.8) & (green < 1.0), lambda part, own: gravel(part)),
    ):
        rows = np.flatnonzero(region)
        if len(rows):
            colour[rows] = paint(s.part(rows), tone[rows])
    rows = np.flatnonzero(green > 0.0)
    if len(rows):
        part = s.part(rows)
        colour[rows] = mix(colour[rows], lawn(part, np.clip(tone[rows], 0.0, 1.0)), green[rows])
    return colour


SCENE = SceneKind(plan=plan_city, paint_ground=paint_city_ground)
