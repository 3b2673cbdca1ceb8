"""What stands in the blocks of a city: rows of houses around yards, slabs in the green, towers, halls, parks."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import IntEnum
from functools import lru_cache

import numpy as np

from aeromatch_cli.data import FloatArray
from aeromatch_cli.lab.synthetic.buildings import Style, draw_style, garages, hall, slab, tower, town_house
from aeromatch_cli.lab.synthetic.cars import car, lorry
from aeromatch_cli.lab.synthetic.scenes.streets import Block, Side, chance, mesh
from aeromatch_cli.lab.synthetic.solids import Footprint, Surface
from aeromatch_cli.lab.synthetic.trees import Species, tree

# Random streams of a block: what it is, its buildings, its trees, its traffic.
_LAYOUT, _BUILD, _GREEN, _TRAFFIC = 31, 32, 33, 34


class Use(IntEnum):
    """What a block is used for."""

    ROWS = 0
    SLABS = 1
    TOWER = 2
    HALLS = 3
    PARK = 4


_SHARES = ((Use.ROWS, 0.56), (Use.SLABS, 0.74), (Use.TOWER, 0.81), (Use.HALLS, 0.90), (Use.PARK, 1.0))
PAVED_YARDS = 0.35  # yards of rows less green than this are paved
_ROOM_M = 30.0  # blocks narrower than this are built up or planted, nothing else fits


@dataclass(frozen=True, eq=False)
class Layout:
    """A block's use and the buildings that stand free in it. depth_m: of the rows along its streets, if any. parked:
    the sides along which cars stand in its yard. green, tone: 0-1, how much grows in it and what it is paved with."""

    use: Use
    depth_m: float
    free: tuple[Footprint, ...]
    parked: tuple[int, ...]
    green: float
    tone: float


@dataclass(eq=False)
class Stock:
    """Solids so far, and how many of each kind."""

    surfaces: list[Surface] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)

    def put(self, kind: str, solid: list[Surface]) -> None:
        self.surfaces += solid
        self.counts[kind] += 1


@lru_cache(maxsize=4096)
def layout(seed: int, i: int, j: int, part: int) -> Layout:
    """What a block is used for; the same for its buildings and for the ground around them."""
    block = mesh(seed, i, j)[part]
    rng = block.rng(seed, _LAYOUT)
    plot = block.plot_uv()
    narrow_m = _narrowest(plot)
    draw = rng.random()
    use = next(use for use, up_to in _SHARES if draw <= up_to)
    if narrow_m < _ROOM_M and use in (Use.SLABS, Use.TOWER, Use.HALLS):
        use = Use.ROWS
    depth_m = min(rng.uniform(10.5, 13.5), 0.36 * narrow_m)
    green, tone = float(rng.random()), float(rng.random())
    free = _in_yard(rng, block, depth_m) if use is Use.ROWS else _free_standing(rng, use, plot)
    sides = {Use.ROWS: int(green <= PAVED_YARDS), Use.SLABS: 2, Use.TOWER: 3, Use.HALLS: 3, Use.PARK: 0}[use]
    parked = tuple(int(k) for k in rng.permutation(4)[:sides])
    return Layout(use, depth_m, free, parked, green, tone)


def _narrowest(plot: FloatArray) -> float:
    """Least distance between opposite sides of a quadrilateral, about."""
    middle = 0.5 * (plot + np.roll(plot, -1, axis=0))
    return float(min(np.linalg.norm(middle[2] - middle[0]), np.linalg.norm(middle[3] - middle[1])))


def _free_standing(rng: np.random.Generator, use: Use, plot: FloatArray) -> tuple[Footprint, ...]:
    center = plot.mean(axis=0)
    longest = int(np.argmax(np.linalg.norm(np.roll(plot, -1, axis=0) - plot, axis=1)))
    along = np.roll(plot, -1, axis=0)[longest] - plot[longest]
    heading_deg = float(np.rad2deg(np.arctan2(along[1], along[0])))
    frame = Footprint(float(center[0]), float(center[1]), 1.0, 1.0, heading_deg)
    own = Footprint(0.0, 0.0, 1.0, 1.0, -heading_deg).at(plot - center)
    long_m, wide_m = 2.0 * float(np.abs(own[:, 0]).min()), 2.0 * float(np.abs(own[:, 1]).min())

    def at(x: float, y: float, length: float, depth: float) -> Footprint:
        (u, v) = frame.at(np.array([[x, y]]))[0]
        return Footprint(float(u), float(v), length, depth, heading_deg)

    if use is Use.SLABS:
        rows = max(1, int(wide_m // 31.0))
        place = (np.arange(rows) - 0.5 * (rows - 1)) * (wide_m - 12.0) / max(rows, 1.6)
        lengths = np.minimum(rng.uniform(0.55, 0.92, rows) * long_m, 78.0) - 3.0
        shifts = rng.uniform(-0.5, 0.5, rows) * (long_m - lengths - 4.0)
        return tuple(
            at(s, y, length, rng.uniform(10.5, 13.0)) for s, y, length in zip(shifts, place, lengths, strict=True)
        )
    if use is Use.TOWER:
        side = min(rng.uniform(16.0, 24.0), 0.45 * wide_m)
        x = rng.uniform(-0.2, 0.2) * long_m
        return (at(x, rng.uniform(-0.1, 0.1) * wide_m, side * rng.uniform(1.0, 1.5), side),)
    if use is Use.HALLS:
        length, depth = rng.uniform(0.45, 0.6) * long_m, rng.uniform(0.5, 0.72) * wide_m
        side = rng.choice([-1.0, 1.0])
        return (at(side * 0.5 * (long_m - length - 4.0), 0.5 * (wide_m - depth - 4.0), length, depth),)
    return ()


def _in_yard(rng: np.random.Generator, block: Block, depth_m: float) -> tuple[Footprint, ...]:
    """Rows of garages in the yard of a block, as far as there is room."""
    yard = block.plot_uv(depth_m + 2.5)
    if _turns_wrong(yard) or _narrowest(yard) < 14.0:
        return ()
    found: list[Footprint] = []
    for _ in range(int(rng.integers(0, 6))):
        k = int(rng.integers(4))
        edge = yard[(k + 1) % 4] - yard[k]
        u, v = rng.uniform(yard.min(axis=0), yard.max(axis=0))
        heading_deg = float(np.rad2deg(np.arctan2(edge[1], edge[0])))
        plan = Footprint(float(u), float(v), rng.uniform(7.0, 22.0), rng.uniform(5.0, 7.5), heading_deg)
        apart = all(np.hypot(u - other.x_m, v - other.y_m) > 20.0 for other in found)
        if apart and all(_inside(yard, corner) for corner in plan.corners_m()):
            found.append(plan)
    return tuple(found)


def build_block(seed: int, block: Block) -> Stock:
    """Everything that stands in a block and on the two streets that it counts as its own."""
    stock = Stock()
    kept = layout(seed, *block.key)
    rng = block.rng(seed, _BUILD)
    if kept.use is Use.ROWS:
        _rows(rng, block, kept, stock)
    for plan in kept.free:
        if kept.use is Use.ROWS:
            stock.put("buildings", garages(rng, plan))
        elif kept.use is Use.SLABS:
            stock.put("buildings", slab(rng, plan, int(rng.integers(4, 11))))
        elif kept.use is Use.TOWER:
            stock.put("buildings", tower(rng, plan, int(rng.integers(11, 19))))
        else:
            stock.put("buildings", hall(rng, plan))
    green = block.rng(seed, _GREEN)
    _plant(green, block, kept, stock)
    _street_trees(green, block, stock)
    _traffic(block.rng(seed, _TRAFFIC), block, stock)
    _parked_inside(block.rng(seed, _TRAFFIC + 1), block, kept, stock)
    return stock


def _rows(rng: np.random.Generator, block: Block, kept: Layout, stock: Stock) -> None:
    """Houses along all streets of a block; those left and right of a corner look alike and make one house."""
    outer, inner = block.plot_uv(), block.plot_uv(kept.depth_m)
    level, pitched = int(rng.integers(4, 7)), float(rng.choice([0.15, 0.55, 0.9]))
    corners = [_style(rng, level, pitched) for _ in range(4)]
    for k in range(4):
        j = (k + 1) % 4
        a, b, d, c = outer[k], outer[j], inner[k], inner[j]
        length_m = float(np.linalg.norm(b - a))
        along = (b - a) / length_m
        first, last = float((d - a) @ along) + 4.0, float((c - a) @ along) - 4.0
        count = max(0, round((last - first) / rng.uniform(15.0, 22.0)))
        cuts = first + (last - first) * (np.arange(count + 1) + 0.5 * rng.uniform(-0.5, 0.5, count + 1)) / max(count, 1)
        cuts = np.clip(cuts, first, last)
        into = np.array([-along[1], along[0]]) * kept.depth_m
        street = [a, *(a + cut * along for cut in cuts), b]
        yard = [d, *(a + cut * along + into for cut in cuts), c]
        for n in range(len(street) - 1):
            plan = np.stack([street[n], street[n + 1], yard[n + 1], yard[n]])
            is_corner = n in (0, len(street) - 2)
            style = corners[k] if n == 0 else corners[j] if is_corner else _style(rng, level, pitched)
            if is_corner or rng.random() > 0.07:
                around = ((3,) if n == 0 else ()) + ((1,) if n == len(street) - 2 else ())
                stock.put("buildings", town_house(rng, plan, style, around))
            if not is_corner and rng.random() < 0.3:
                _wing(rng, plan, block, kept, stock)


def _style(rng: np.random.Generator, level: int, pitched: float) -> Style:
    storeys = 1 if rng.random() < 0.04 else int(np.clip(level + rng.integers(-1, 3), 3, 8))
    return draw_style(rng, storeys, pitched)


def _wing(rng: np.random.Generator, plan: FloatArray, block: Block, kept: Layout, stock: Stock) -> None:
    """A lower building behind a house, into the yard."""
    room_m = 0.5 * _narrowest(block.plot_uv(kept.depth_m)) - 3.0
    wide_m = float(np.linalg.norm(plan[2] - plan[3]))
    if room_m < 5.0 or wide_m < 9.0:
        return
    along = (plan[2] - plan[3]) / wide_m
    into = np.array([-along[1], along[0]])
    start = plan[3] + rng.uniform(0.5, 0.4 * wide_m) * along
    width, depth = rng.uniform(4.5, 0.55 * wide_m), rng.uniform(0.5, 1.0) * min(room_m, 12.0)
    corners = np.stack([start, start + width * along, start + width * along + depth * into, start + depth * into])
    stock.put("buildings", town_house(rng, corners, draw_style(rng, int(rng.integers(1, 4)), 0.2)))


def _plant(rng: np.random.Generator, block: Block, kept: Layout, stock: Stock) -> None:
    """Trees and shrubs in yards, between slabs, in parks."""
    margin_m = kept.depth_m + 3.0 if kept.use is Use.ROWS else 4.0
    per_m2 = {Use.ROWS: 0.013, Use.SLABS: 0.013, Use.TOWER: 0.008, Use.HALLS: 0.002, Use.PARK: 0.019}[kept.use]
    plot = block.plot_uv(margin_m)
    lo, hi = plot.min(axis=0), plot.max(axis=0)
    if _narrowest(plot) < 4.0 or _turns_wrong(plot):
        return
    density = per_m2 * (0.35 + 1.3 * kept.green)
    point = rng.uniform(lo, hi)
    for _ in range(int(density * float(np.prod(hi - lo)))):
        # Half of them stand in groups.
        point = rng.uniform(lo, hi) if rng.random() < 0.5 else point + rng.normal(0.0, 5.5, size=2)
        shrub = rng.random() < 0.2
        radius_m = rng.uniform(0.7, 1.8) if shrub else 2.0 + 4.0 * rng.random() ** 1.3
        if not _inside(plot, point) or _too_close(kept, point, 0.75 * radius_m + 0.8):
            continue
        stock.put("trees", _any_tree(rng, point, radius_m, shrub))


def _any_tree(rng: np.random.Generator, uv_m: FloatArray, radius_m: float, shrub: bool) -> list[Surface]:
    u, v = float(uv_m[0]), float(uv_m[1])
    if shrub:
        return tree(rng, u, v, 0.0, radius_m, radius_m * rng.uniform(0.9, 1.4), Species.SHRUB)
    draw = rng.random()
    if draw < 0.08:
        return tree(rng, u, v, 0.0, 0.6 * radius_m, radius_m * rng.uniform(2.6, 3.6), Species.CONIFER)
    if draw < 0.18:
        return tree(rng, u, v, 0.0, 0.55 * radius_m, radius_m * rng.uniform(2.4, 3.2), Species.COLUMN)
    return tree(rng, u, v, 0.0, radius_m, radius_m * rng.uniform(1.7, 2.5) + 1.5, Species.BROADLEAF)


def _turns_wrong(plot: FloatArray) -> bool:
    edge = np.roll(plot, -1, axis=0) - plot
    after = np.roll(edge, -1, axis=0)
    return bool((edge[:, 0] * after[:, 1] - edge[:, 1] * after[:, 0] <= 0.0).any())


def _inside(plot: FloatArray, point: FloatArray) -> bool:
    edge, offset = np.roll(plot, -1, axis=0) - plot, point - plot
    return bool((edge[:, 0] * offset[:, 1] - edge[:, 1] * offset[:, 0] > 0.0).all())


def _too_close(kept: Layout, point: FloatArray, distance_m: float) -> bool:
    for plan in kept.free:
        own = Footprint(0.0, 0.0, 1.0, 1.0, -plan.heading_deg).at(point[None] - [plan.x_m, plan.y_m])[0]
        beyond = np.abs(own) - 0.5 * np.array([plan.length_x_m, plan.length_y_m])
        if beyond.max() < distance_m:
            return True
    return False


def _street_trees(rng: np.random.Generator, block: Block, stock: Stock) -> None:
    for side in block.sides:
        if rng.random() > (0.75 if side.pavement_m > 3.0 else 0.25):
            continue
        at, heading, length = _beside(side, side.half_m + 0.9)
        top_m = min(0.75 * side.pavement_m + 0.7, 3.4)
        spacing, tall = rng.uniform(6.5, 11.0), rng.uniform(1.7, 2.5)
        for along in np.arange(side.half_m + 9.0, length - side.half_m - 9.0, spacing):
            if rng.random() < 0.78:
                radius_m = top_m * rng.uniform(0.65, 1.0)
                u, v = at + (along + rng.uniform(-0.6, 0.6)) * heading
                stock.put(
                    "trees", tree(rng, float(u), float(v), 0.0, radius_m, radius_m * tall + 2.0, Species.BROADLEAF)
                )


def _beside(side: Side, distance_m: float) -> tuple[FloatArray, FloatArray, float]:
    """Start (2,), direction (2,) and length of the line along a side at some distance from the axis."""
    edge = side.end_uv - side.start_uv
    length = float(np.linalg.norm(edge))
    heading = edge / length
    return side.start_uv + distance_m * np.array([-heading[1], heading[0]]), heading, length


def _traffic(rng: np.random.Generator, block: Block, stock: Stock) -> None:
    """Cars parked along the kerb and driving in the lanes of this half of each street."""
    for side in block.sides:
        # On the block's own half of a street one drives against its counter-clockwise sense (on the right).
        parks, crowded = side.half_m > 3.9, rng.uniform(0.15, 0.85)
        at, heading, length = _beside(side, side.half_m - 1.05)
        turn_deg = float(np.rad2deg(np.arctan2(heading[1], heading[0])))
        ends = side.half_m + 12.0
        where = ends + rng.uniform(0.0, 2.0)
        while parks and where < length - ends:
            if rng.random() < crowded:
                u, v = at + where * heading + rng.uniform(-0.12, 0.12, 2)
                flip = 180.0 if rng.random() < 0.2 else 0.0
                stock.put("cars", car(rng, float(u), float(v), turn_deg + flip + rng.uniform(-2.0, 2.0)))
            where += rng.uniform(5.2, 6.6)
        lanes = (1.9, 4.95) if side.wide else (1.45,)
        for lane in lanes:
            at, heading, length = _beside(side, lane)
            where = ends + rng.exponential(30.0)
            while where < length - ends:
                u, v = at + where * heading
                solid = lorry if rng.random() < 0.08 else car
                stock.put("cars", solid(rng, float(u), float(v), turn_deg + rng.uniform(-1.5, 1.5)))
                where += 13.0 + rng.exponential(24.0 if side.wide else 60.0)


def _parked_inside(rng: np.random.Generator, block: Block, kept: Layout, stock: Stock) -> None:
    """Rows of parked cars around halls and towers, a few in yards."""
    if not kept.parked:
        return
    margin_m = kept.depth_m + 3.6 if kept.use is Use.ROWS else 3.6
    plot = block.plot_uv(margin_m)
    if _narrowest(plot) < 9.0 or _turns_wrong(plot):
        return
    for k in kept.parked:
        edge = np.roll(plot, -1, axis=0)[k] - plot[k]
        length = float(np.linalg.norm(edge))
        heading = edge / length
        turn_deg = float(np.rad2deg(np.arctan2(heading[1], heading[0])))
        for along in np.arange(4.0, length - 4.0, 2.6):
            point = plot[k] + along * heading + rng.uniform(-0.15, 0.15, 2)
            if rng.random() < 0.55 and not _too_close(kept, point, 3.2):
                flip = 180.0 if rng.random() < 0.5 else 0.0
                stock.put(
                    "cars", car(rng, float(point[0]), float(point[1]), turn_deg + 90.0 + flip + rng.uniform(-3, 3))
                )


def is_red(seed: int, block: Block) -> bool:
    """Whether the pavements around a block are laid in red."""
    return chance(seed, 25, *block.key[:2]) < 0.3
